"""Solid primitives for the procedural shapes: thin wrappers of manifold3d.

z is up, angles are in radians. Every function returns closed `Manifold`s; unions are
left to the caller, so that a shape is one single boolean operation.
"""

import itertools
from collections.abc import Callable, Sequence

import numpy as np
import trimesh
from jaxtyping import Float
from manifold3d import CrossSection, Manifold, Mesh64, OpType, triangulate

SPLINTER = 1e-7  # volume below which a separate piece is an artefact of touching faces

Rng = np.random.Generator
Solids = list[Manifold]
Vector = Sequence[float | int] | np.ndarray


def box(center: Vector, size: Vector, chamfer: float = 0.0) -> Manifold:
    """Axis-aligned box, its twelve edges cut at `chamfer` when that is positive."""
    half = np.asarray(size, float) / 2
    if chamfer <= 0:
        return Manifold.cube(2 * half, True).translate(np.asarray(center, float))
    chamfer = min(chamfer, 0.45 * 2 * half.min())
    signs = np.array(np.meshgrid(*[(-1, 1)] * 3)).reshape(3, -1).T
    insets = np.concatenate(
        [signs * (half - chamfer * (1 - np.eye(3)[axis])) for axis in range(3)]
    )
    return Manifold.hull_points(insets + np.asarray(center, float))


def ball(center: Vector, radius: float | Vector, segments: int = 20) -> Manifold:
    """Sphere, or an axis-aligned ellipsoid when `radius` has three entries."""
    scale = np.broadcast_to(np.asarray(radius, float), 3)
    return (
        Manifold.sphere(1.0, segments).scale(scale).translate(np.asarray(center, float))
    )


def rod(
    start: Vector,
    end: Vector,
    radius: float,
    end_radius: float | None = None,
    segments: int = 20,
) -> Manifold:
    """Cylinder from `start` to `end`, or a frustum when `end_radius` differs."""
    start, end = np.asarray(start, float), np.asarray(end, float)
    length = float(np.linalg.norm(end - start))
    top = radius if end_radius is None else end_radius
    solid = Manifold.cylinder(length, radius, top, segments)
    return place(solid, axes_along(end - start), start)


def tube(
    start: Vector, end: Vector, radius: float, bore: float, segments: int = 16
) -> Manifold:
    """Cylinder from `start` to `end` with a hole of the radius `bore` right through it,
    or without one where that is zero."""
    start, end = np.asarray(start, float), np.asarray(end, float)
    section = CrossSection.circle(radius, segments)
    if bore > 0:
        section -= CrossSection.circle(bore, segments)
    solid = section.extrude(float(np.linalg.norm(end - start)))
    return place(solid, axes_along(end - start), start)


def bar(
    start: Vector, end: Vector, width: float, depth: float, end_scale: float = 1.0
) -> Manifold:
    """Rectangular beam from `start` to `end`; its end section is `end_scale` times
    the start's. The width lies along x where the beam is upright."""
    start, end = np.asarray(start, float), np.asarray(end, float)
    length = float(np.linalg.norm(end - start))
    section = CrossSection.square((width, depth), True)
    solid = section.extrude(length, scale_top=(end_scale, end_scale))
    return place(solid, axes_along(end - start), start)


def capsule(
    start: Vector,
    end: Vector,
    radius: float,
    end_radius: float | None = None,
    segments: int = 16,
) -> Manifold:
    """Convex hull of two spheres."""
    other = radius if end_radius is None else end_radius
    return Manifold.batch_hull(
        [ball(start, radius, segments), ball(end, other, segments)]
    )


def tube_along(points: np.ndarray, radius: float, segments: int = 10) -> Solids:
    """Capsules between consecutive rows of `points`."""
    ends = itertools.pairwise(points)
    return [capsule(*pair, radius, segments=segments) for pair in ends]


def lathe(profile: Sequence[Vector], segments: int = 32) -> Manifold:
    """Solid of revolution about z of the polygon of (radius, z) pairs, closed along
    the axis. Heights must rise."""
    outline = np.asarray(profile, float)
    closed = np.vstack([[0.0, outline[0, 1]], outline, [0.0, outline[-1, 1]]])
    return CrossSection([closed]).revolve(segments)


def prism(outline: np.ndarray, height: float) -> Manifold:
    """Extrusion along z from z = 0 of a simple counter-clockwise polygon in x, y."""
    return CrossSection([np.asarray(outline, float)]).extrude(height)


def side_profile(outline: np.ndarray, width: float) -> Manifold:
    """Extrusion along x, centred, of a counter-clockwise polygon of (y, z) pairs."""
    cyclic = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    return place(prism(outline, width), cyclic, np.array([-width / 2, 0.0, 0.0]))


def front_profile(outline: np.ndarray, depth: float) -> Manifold:
    """Extrusion along y, centred, of a counter-clockwise polygon of (x, z) pairs."""
    upright = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    return place(prism(outline, depth), upright, np.array([0.0, depth / 2, 0.0]))


def torus(
    radius: float,
    thickness: float,
    degrees: float = 360.0,
    segments: int = 24,
    around: int = 10,
) -> Manifold:
    """Torus about z, or its part from the +x axis on; `thickness` is the tube's
    radius and `around` its number of sides."""
    section = CrossSection.circle(thickness, around).translate((radius, 0.0))
    return section.revolve(segments, degrees)


def ellipse(center: Vector, radii: Vector, segments: int = 24) -> np.ndarray:
    """Points of an ellipse in the x, z plane at `center`, for hulls along y."""
    angle = np.linspace(0, 2 * np.pi, segments, endpoint=False)
    ring = [radii[0] * np.cos(angle), 0 * angle, radii[1] * np.sin(angle)]
    return np.stack(ring, axis=1) + np.asarray(center, float)


def loft(sections: Sequence[np.ndarray]) -> Solids:
    """Convex hulls of consecutive sections, each a set of points."""
    return [
        Manifold.hull_points(np.concatenate([first, second]))
        for first, second in itertools.pairwise(sections)
    ]


def sweep(
    path: Float[np.ndarray, "P 3"],
    outline: Float[np.ndarray, "N 2"],
    scales: Float[np.ndarray, " P"] | None = None,
) -> Manifold:
    """What a simple counter-clockwise outline covers that is moved along a path of
    distinct points, always across it; at each point it has its own scale.

    The outline's x axis starts close to the x axis, and turns no more than the path
    does. A path that bends within the outline's reach gives a solid that overlaps
    itself. A path that turns straight back raises ValueError.
    """
    steps = np.diff(path, axis=0)
    steps /= np.linalg.norm(steps, axis=1, keepdims=True)
    tangents = np.concatenate([steps[:1], steps[:-1] + steps[1:], steps[-1:]])
    lengths = np.linalg.norm(tangents, axis=1, keepdims=True)
    if lengths.min() < 1e-6:
        raise ValueError("the path turns straight back")
    x_axis, rings = axes_along(tangents[0])[:, 0], []
    sizes = np.ones(len(path)) if scales is None else scales
    for point, tangent, scale in zip(path, tangents / lengths, sizes, strict=True):
        x_axis = x_axis - (x_axis @ tangent) * tangent
        x_axis /= np.linalg.norm(x_axis)
        axes = np.stack([x_axis, np.cross(tangent, x_axis)])
        rings.append(point + scale * outline @ axes)
    count, cap = len(outline), triangulate([np.asarray(outline, float)])
    walls = _strips(np.arange(len(path) * count).reshape(len(path), count))
    ends = cap[:, ::-1], cap + count * (len(path) - 1)
    return _closed(np.concatenate(rings), np.concatenate([walls, *ends]))


def slab(
    upper: Float[np.ndarray, "U V 3"], lower: Float[np.ndarray, "U V 3"]
) -> Manifold:
    """What lies between two grids of points, `upper` above where U runs along x and V
    along y."""
    count_u, count_v, _ = upper.shape
    top = np.arange(count_u * count_v).reshape(count_u, count_v)
    bottom = top + top.size
    faces = [_grid_faces(top), _grid_faces(bottom)[:, ::-1]]
    rim = [
        np.concatenate([g[:, 0], g[-1, 1:], g[-2::-1, -1], g[0, -2:0:-1]])
        for g in (bottom, top)
    ]
    points = np.concatenate([upper.reshape(-1, 3), lower.reshape(-1, 3)])
    return _closed(points, np.concatenate([*faces, _strips(np.stack(rim))]))


def _grid_faces(index: np.ndarray) -> np.ndarray:
    """Two triangles for each cell of a grid, counter-clockwise about rows x columns."""
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    return np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3)


def _strips(rings: np.ndarray) -> np.ndarray:
    """Faces between consecutive rings, each counter-clockwise about the way on."""
    return _grid_faces(np.concatenate([rings, rings[:, :1]], axis=1).T)


def _closed(points: np.ndarray, faces: np.ndarray) -> Manifold:
    mesh = Mesh64(
        np.ascontiguousarray(points, np.float64), np.ascontiguousarray(faces, np.uint64)
    )
    return Manifold(mesh)


def ring_of(solid: Manifold, count: int, start: float = 0.0) -> Solids:
    """Copies of a solid turned about z by equal steps, the first by `start` degrees."""
    return [solid.rotate((0, 0, start + 360 * k / count)) for k in range(count)]


def corners(x: float, y: float) -> list[np.ndarray]:
    """The four points (+-x, +-y, 0)."""
    return [np.array((sx * x, sy * y, 0.0)) for sx in (-1, 1) for sy in (-1, 1)]


def on_floor(solids: Sequence[Manifold]) -> Solids:
    """The solids, moved together along z until the lowest touches z = 0."""
    lowest = min(solid.bounding_box()[2] for solid in solids)
    return [solid.translate((0, 0, -lowest)) for solid in solids]


def axes_along(direction: np.ndarray) -> np.ndarray:
    """Rotation whose third column is `direction`, its first close to the x axis."""
    z_axis = direction / np.linalg.norm(direction)
    helper = (1.0, 0.0, 0.0) if abs(z_axis[0]) < 0.95 else (0.0, 1.0, 0.0)
    y_axis = np.cross(z_axis, helper)
    y_axis /= np.linalg.norm(y_axis)
    return np.stack([np.cross(y_axis, z_axis), y_axis, z_axis], axis=1)


def place(solid: Manifold, rotation: np.ndarray, origin: np.ndarray) -> Manifold:
    """Rotates a solid by a 3x3 matrix, then moves it to `origin`."""
    return solid.transform(np.column_stack([rotation, origin]))


def union(solids: Sequence[Manifold]) -> Manifold:
    """Boolean union of all solids at once."""
    return Manifold.batch_boolean(list(solids), OpType.Add)


def assembled(solids: Sequence[Manifold]) -> Solids:
    """Their union, moved along z until it touches z = 0; enclosed voids are filled,
    and the splinters that touching faces leave behind are dropped."""
    whole = union(on_floor(solids))
    parts = whole.decompose()
    if len(parts) > 1:
        whole = union([part for part in parts if part.volume() > SPLINTER])
    return [whole]


def one_of(
    rng: Rng,
    makers: Sequence[Callable[[Rng], Solids]],
    shares: Sequence[float],
) -> Solids:
    """What one of some functions draws, chosen by these shares."""
    return makers[rng.choice(len(makers), p=shares)](rng)


def as_mesh(solid: Manifold) -> trimesh.Trimesh:
    """A solid's surface, vertices and triangles as they are."""
    mesh = solid.to_mesh64()
    vertices = np.array(mesh.vert_properties)[:, :3]
    return trimesh.Trimesh(vertices, np.array(mesh.tri_verts), process=False)
