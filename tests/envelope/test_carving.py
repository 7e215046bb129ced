"""Free space on random scenes: nothing that is there is in it."""

import numpy as np
import pytest
from scipy import ndimage

from prism_jax.envelope.carving import (
    Carving,
    _least,
    carve,
    check_agreement,
    check_conflicts,
    proven,
    view_of_cloud,
    view_of_depth,
)
from prism_jax.envelope.voxels import Grid
from prism_jax.geometry.camera import Camera
from prism_jax.io.errors import InputError

FAR = np.array([400_000.0, -5_000_000.0, 120.0])
"""As survey coordinates have it."""


BODY, MARGIN = 0.1, 0.04


def camera_at(eye, width=64, height=48, focal=40.0):
    """Looks along +z, x to the right."""
    middle = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2]])
    intrinsics = np.concatenate([middle, [[0, 0, 1.0]]])
    return Camera(np.eye(3), -np.asarray(eye, float), intrinsics, height, width)


def wall_view(eye, distance, camera=None):
    """A wall across the view, seen by every pixel."""
    camera = camera or camera_at(eye)
    depth = np.full((camera.height, camera.width), float(distance))
    return view_of_depth(depth, depth > 0, camera)


def test_the_least_value_of_rectangles_is_bounded():
    rng = np.random.default_rng(0)
    image = rng.random((23, 37))
    first = rng.integers(0, (23, 37), (200, 2))
    last = np.minimum(first + rng.integers(0, 12, (200, 2)), (22, 36))
    least = _least(image, first, last)
    for (top, left), (bottom, right), value in zip(first, last, least, strict=True):
        inside = image[top : bottom + 1, left : right + 1]
        assert value <= inside.min()
        side = max(inside.shape)
        if min(top, left) >= side and bottom + side < 23 and right + side < 37:
            wide = image[top - side : bottom + side + 1, left - side : right + side + 1]
            assert value >= wide.min()
    assert _least(image, first[:1] - 30, last[:1])[0] == 0.0
    square = np.minimum(first + 7, (22, 36))
    whole = (square - first == 7).all(axis=1)
    exact = _least(image, first[whole], square[whole])
    for (top, left), value in zip(first[whole], exact, strict=True):
        assert value == image[top : top + 8, left : left + 8].min()


@pytest.mark.parametrize("origin", [np.zeros(3), FAR])
@pytest.mark.parametrize("margin", [0.0, 0.15])
def test_free_is_what_lies_before_a_wall_by_the_margin_and_in_view(origin, margin):
    grid = Grid.over(origin + (-1, -1, 0.5), origin + (1, 1, 3.5), 0.1)
    view = wall_view(origin, 2.0)
    free = carve(grid, view, Carving(margin, 0.2))
    middles = grid.centers() - origin
    margin += 0.2
    # Closed form: every corner and a pixel around it within the pyramid, the last one
    # before the wall.
    half = 0.05
    near, end = middles[:, 2] - half, middles[:, 2] + half
    reach = np.abs(middles[:, :2]) + half
    in_view = (reach * 40.0 / near[:, None] < (31, 23)).all(axis=1)
    expected = in_view & (end + margin < 2.0 - 1e-6)
    # Rounding decides what ends at the wall, or at the image's border.
    clear = np.abs(end + margin - 2.0) > 1e-4
    clear &= (np.abs(reach * 40.0 / near[:, None] - (31.0, 23.0)) > 0.01).all(axis=1)
    np.testing.assert_array_equal(free.ravel()[clear], expected[clear])
    assert expected[clear].any()


def test_no_voxel_that_a_sphere_reaches_into_is_free():
    eye, center, radius = np.array([0, 0, -2.0]), np.array([0.1, 0, 0]), 0.4
    camera = camera_at(eye, 160, 120, 150.0)
    rows, columns = np.indices((120, 160))
    across = [(columns - 79.5) / 150, (rows - 59.5) / 150]
    rays = np.stack([*across, np.ones((120, 160))], axis=2)
    # |t r - (c - e)| = radius, the nearer root; a wall behind.
    toward = center - eye
    a, b = (rays**2).sum(2), rays @ toward
    root = b**2 - a * (toward @ toward - radius**2)
    depth = np.where(root > 0, (b - np.sqrt(np.maximum(root, 0))) / a, 5.0)
    grid = Grid.over(np.full(3, -1.0), np.full(3, 1.0), 0.05)
    view = view_of_depth(depth, depth > 0, camera)
    free = carve(grid, view, Carving(0.005, 0.1)).ravel()
    gap = np.maximum(np.abs(grid.centers() - center) - 0.025, 0.0)
    reached = np.linalg.norm(gap, axis=1) < radius
    assert free.sum() > 0.2 * free.size
    assert not (free & reached).any()
    # Nor is any in its shadow: behind its middle, on the line of sight.
    behind = np.array([[0.1, 0, 0.6], [0.1, 0, 0.9]])
    assert not free[grid.index_of(behind)].any()


def test_what_was_not_measured_frees_nothing():
    grid = Grid.over(np.array([-1, -1, 0.5]), np.array([1, 1, 3.5]), 0.1)
    camera = camera_at(np.zeros(3))
    nothing = np.zeros((48, 64))
    assert not carve(grid, view_of_depth(nothing, nothing > 0, camera)).any()
    assert not carve(grid, view_of_cloud(np.zeros((0, 3)), np.zeros(3))).any()
    assert not carve(grid, view_of_cloud(np.ones((1, 3)), np.zeros(3))).any()
    assert not carve(grid, view_of_cloud(np.ones((9, 3)), np.zeros(3))).any()
    behind = camera_at(np.array([0, 0, 9.0]))
    assert not carve(grid, wall_view(None, 2.0, behind)).any()


def test_holes_free_nothing_that_a_body_fits_into():
    """At 1 m a ball of 10 cm covers 2 x 2 pixels of a pitch of 1/40 wherever it is."""
    grid = Grid.over(np.array([-0.3, -0.3, 1]), np.array([0.3, 0.3, 1.1]), 0.1)
    camera = camera_at(np.zeros(3))
    depth = np.full((48, 64), 3.0)
    for lost, proves in (
        (1, 0.1 / np.sqrt(2) * 40 / 2),
        (3, 0.1 / np.sqrt(2) * 40 / 4),
    ):
        depth[20 : 20 + lost, 30 : 30 + lost] = 0.0
        view = view_of_depth(depth, depth > 0, camera)
        assert proven(view.depth, 1 / 40, 0.1, False)[20, 30] == pytest.approx(proves)
        inside = carve(grid, view, Carving(0.1, 0.1))
        assert inside.all() == (proves > 1.3)
        assert inside.any()


@pytest.mark.parametrize("origin", [np.zeros(3), FAR])
def test_a_cloud_frees_what_is_before_its_surface_and_nothing_beside_it(origin):
    steps = np.linspace(-0.5, 0.5, 90)
    x, y = (axis.ravel() for axis in np.meshgrid(steps, steps))
    wall = np.stack([x, y, np.full(x.size, 2.0)], axis=1) + origin
    grid = Grid.over(origin + (-0.8, -0.8, 1), origin + (0.8, 0.8, 2.4), 0.1)
    free = carve(grid, view_of_cloud(wall, origin), Carving(0.05, 0.15))
    middles = grid.centers() - origin
    before = (np.abs(middles[:, :2]).max(axis=1) < 0.15) & (middles[:, 2] < 1.6)
    assert free.ravel()[before].all()
    sight = middles[:, :2] / middles[:, 2:]
    beside = (np.abs(sight).max(axis=1) > 0.3) | (middles[:, 2] > 2.0)
    assert not free.ravel()[beside].any()


class Things:
    """Balls, upright posts and turned boxes, some of which return no light."""

    def __init__(self, rng, count):
        self.kind = rng.choice(["ball", "post", "box", "plate"], count)
        self.center = rng.uniform([-1.2, -1.2, -0.8], [1.2, 1.2, 0.8], (count, 3))
        self.half = rng.uniform(0.5, 4.0, (count, 3)) * BODY
        self.half[:, 2] = np.where(self.kind == "post", 0.5, self.half[:, 2])
        self.half[self.kind == "plate", 0] = 0.005
        turn = rng.uniform(0, np.pi, count)
        self.axes = np.zeros((count, 3, 3))
        self.axes[:, 0, :2] = np.stack([np.cos(turn), np.sin(turn)], axis=1)
        self.axes[:, 1, :2] = np.stack([-np.sin(turn), np.cos(turn)], axis=1)
        self.axes[:, 2, 2] = 1.0
        self.dark = rng.random(count) < 0.5

    def __len__(self):
        return len(self.kind)

    def hit(self, row, eye, rays):
        """How far along each ray a thing is; infinite where it is missed."""
        away = eye - self.center[row]
        radius = self.half[row, 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            if self.kind[row] == "ball":
                terms = (rays**2).sum(1), rays @ away, away @ away
                near = _of_quadric(*terms, radius)
                return np.where(near > 0, near, np.inf)
            local, start = rays @ self.axes[row].T, self.axes[row] @ away
            ends = np.stack([-self.half[row] - start, self.half[row] - start])
            ends = ends[:, None] / local
            near, far = np.nanmin(ends, axis=0), np.nanmax(ends, axis=0)
            if self.kind[row] == "post":
                flat = local[:, :2], start[:2]
                terms = (flat[0] ** 2).sum(1), flat[0] @ flat[1], flat[1] @ flat[1]
                entry = _of_quadric(*terms, radius)
                leave = _of_quadric(*terms, radius, far=True)
                near, far = np.maximum(entry, near[:, 2]), np.minimum(leave, far[:, 2])
            else:
                near, far = near.max(axis=1), far.min(axis=1)
        return np.where((near <= far) & (near > 0), near, np.inf)

    def surface(self, row, rng, count=2000):
        """Points on a thing; of boxes none where no ball of `BODY` touches the face."""
        unit = rng.normal(size=(count, 3))
        unit /= np.linalg.norm(unit, axis=1, keepdims=True)
        half = self.half[row]
        if self.kind[row] == "ball":
            return self.center[row] + half[0] * unit
        if self.kind[row] == "post":
            unit[:, :2] /= np.linalg.norm(unit[:, :2], axis=1, keepdims=True)
            rise = rng.uniform(-1, 1, count) * (half[2] - 0.5 * BODY)
            return self.center[row] + np.column_stack([half[0] * unit[:, :2], rise])
        inner = half if self.kind[row] == "plate" else half - 0.5 * BODY
        points = rng.uniform(-1, 1, (count, 3)) * np.maximum(inner, 0.0)
        side = rng.integers(3, size=count)
        face = np.sign(rng.normal(size=count)) * half[side]
        points[np.arange(count), side] = face
        return self.center[row] + points @ self.axes[row]


def _of_quadric(square, mixed, rest, radius, far=False):
    root = mixed**2 - square * (rest - radius**2)
    step = np.sqrt(np.maximum(root, 0.0)) * (1 if far else -1)
    return np.where(root >= 0, (-mixed + step) / square, -np.inf if far else np.inf)


def scene(seed):
    """What a random sensor measures of random things, and which voxels are free."""
    rng = np.random.default_rng(seed)
    things, sweep = Things(rng, rng.integers(1, 7)), rng.random() < 0.5
    eye = rng.uniform([-3, -3, -0.5], [3, 3, 1.0])
    while np.abs(eye).max() < 1.8:
        eye = rng.uniform([-3, -3, -0.5], [3, 3, 1.0])
    if sweep:
        columns, rows = rng.integers(500, 2000), rng.integers(16, 200)
        azimuth = np.linspace(-np.pi, np.pi, columns, endpoint=False)
        azimuth = azimuth + np.arctan2(-eye[1], -eye[0])
        elevation = np.linspace(*np.sort(rng.uniform(-0.9, 0.9, 2)), rows)[:, None]
        parts = np.cos(azimuth), np.sin(azimuth), np.tan(elevation)
        rays = np.stack(np.broadcast_arrays(*parts), axis=-1)
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    else:
        height, width = map(int, rng.integers(60, 200, 2))
        angle = rng.uniform(40, 80)
        target = rng.uniform(-0.5, 0.5, 3)
        camera = Camera.look_at(eye, target, (0, 0, 1), angle, height, width)
        rays = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1)
        rays = np.concatenate([rays, np.ones((height, width, 1))], axis=-1)
        rays = rays @ np.linalg.inv(np.asarray(camera.intrinsics, np.float64)).T
        rays = rays @ np.asarray(camera.rotation, np.float64)
    flat = rays.reshape(-1, 3)
    depth = rng.uniform(3.0, 6.0) * np.ones(len(flat))  # of the room
    dark = np.zeros(len(flat), bool)
    for row in range(len(things)):
        hit = things.hit(row, eye, flat)
        dark = np.where(hit < depth, things.dark[row], dark)
        depth = np.minimum(depth, hit)
    lost = dark | (rng.random(len(flat)) < rng.choice([0, 0.01, 0.1, 0.5]))
    hits = eye + depth[:, None] * flat
    if rng.random() < 0.3:  # a filter took a box out
        corner = rng.uniform(-1.5, 1.5, (2, 3))
        lost |= ((hits > corner.min(0)) & (hits < corner.max(0))).all(axis=1)
    noise = rng.normal(0, MARGIN / 8, len(flat)) / np.linalg.norm(flat, axis=1)
    measured = np.where(lost, np.inf, depth + noise).reshape(rays.shape[:2])
    if sweep or rng.random() < 0.3:
        known = np.isfinite(measured)
        view = view_of_cloud(eye + measured[known][:, None] * rays[known], eye)
    else:
        view = view_of_depth(
            np.where(lost.reshape(measured.shape), 0, measured),
            np.isfinite(measured),
            camera,
        )
    grid = Grid.over(np.full(3, -1.5), np.full(3, 1.5), 0.06)
    return things, eye, rays, measured, grid, carve(grid, view, Carving(MARGIN, BODY))


def occupied(seed):
    """Points of true surfaces in voxels that are called free, by kind, but for plates
    that measured rays passed on all sides; and the number of free voxels."""
    things, eye, rays, measured, grid, free = scene(seed)
    rng, found = np.random.default_rng(seed), []
    for row in range(len(things)):
        points = things.surface(row, rng)
        index = grid.index_of(points)
        points = points[(index >= 0) & free.ravel()[index]]
        if things.kind[row] == "plate" and len(points):
            points = points[~_passed(points, eye, rays, measured)]
        found += [things.kind[row]] * len(points)
    return found, int(free.sum())


def _passed(points, eye, rays, measured):
    """Whether measured rays went on around each point's line of sight, so near that no
    ball of `BODY` across it would hide from them."""
    length = np.linalg.norm(rays, axis=-1)
    directions = rays / length[..., None]
    steps = [np.linalg.norm(np.diff(directions, axis=a), axis=-1).max() for a in (0, 1)]
    passed = np.zeros(len(points), bool)
    for number, point in enumerate(points):
        away = np.linalg.norm(point - eye)
        side = max(int(BODY / np.sqrt(2) / away / max(steps) + 0.1), 1)
        bad = ~np.isfinite(measured) | (measured * length <= away)
        bad = np.pad(bad, side + 1, constant_values=True)
        hidden = ndimage.binary_opening(bad, np.ones((side, side)))
        cosine = directions @ ((point - eye) / away)
        row, column = np.unravel_index(cosine.argmax(), cosine.shape)
        about = hidden[row + side : row + side + 3, column + side : column + side + 3]
        passed[number] = not about.any()
    return passed


@pytest.mark.parametrize(
    "seeds", [range(12), pytest.param(range(12, 160), marks=pytest.mark.slow)]
)
def test_nothing_is_in_free_space(seeds):
    free = 0
    for seed in seeds:
        found, count = occupied(seed)
        assert not found, seed
        free += count
    assert free > 1000 * len(seeds)


@pytest.mark.parametrize(
    ("width", "distance"), [(0.02, 1), (0.02, 2), (0.02, 3), (0.1, 2)]
)
def test_a_post_that_returns_nothing_is_not_free(width, distance):
    """Before a wall at 4 m, from a depth image of 640 x 480 and from its cloud."""
    camera = camera_at(np.zeros(3), 640, 480, 460.0)
    column = (np.arange(640) - 319.5) / 460.0 * distance
    depth = np.full((480, 640), 4.0)
    depth[:, np.abs(column - 0.013) <= width / 2] = 0.0
    grid = Grid.over(
        np.array([-0.2, -0.2, distance - 0.2]), np.array([0.2, 0.2, distance + 0.2])
    )
    rows, columns = np.nonzero(depth)
    rays = np.stack(
        [(columns - 319.5) / 460, (rows - 239.5) / 460, np.ones(len(rows))], 1
    )
    post = np.column_stack(
        [np.full(99, 0.013), np.linspace(-0.19, 0.19, 99), np.full(99, distance)]
    )
    index = grid.index_of(post)
    for view in (
        view_of_depth(depth, depth > 0, camera),
        view_of_cloud(4.0 * rays, np.zeros(3)),
    ):
        free = carve(grid, view).ravel()
        assert not free[index].any()
    assert free.any() or distance == 3 or width > 0.02


def test_a_scan_that_its_depth_image_contradicts_is_refused():
    camera = camera_at(np.zeros(3))
    view = wall_view(np.zeros(3), 2.0, camera)
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (100, 3)) * [1, 1, 0] + [
        0,
        0,
        2.0,
    ]
    check_agreement(view, points, Carving())
    for wrong in (points * 1.1, points + [0, 0, 0.4], points * 1000):
        with pytest.raises(
            InputError, match="0% of the scan's points lie on the depth image"
        ):
            check_agreement(view, wrong, Carving())
    grid = Grid.over(np.full(3, -0.5), np.full(3, 0.5), 0.1)
    free = np.zeros(grid.shape, bool)
    check_conflicts(grid, free, points - [0, 0, 2.0])
    free[:, :, 5] = True
    with pytest.raises(InputError, match="voxels with measured points are called free"):
        check_conflicts(grid, free, points - [0, 0, 2.0])
