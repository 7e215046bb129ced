"""Parts that are found again in what a sensor saw of them."""

import dataclasses

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from experiments.simulation.raycast import Scene
from experiments.simulation.readings import camera_rays
from prism_jax.io.errors import InputError
from prism_jax.preprocessing.visibility_map import seen_among
from prism_jax.registration import evidence, library, surface
from prism_jax.registration.library import Library, Model
from prism_jax.registration.pose import refine, rigid
from prism_jax.registration.scan import Scan
from prism_jax.registration.surface import surface_of

EYE = np.array([1.2, 0.9, 0.8])
NOISE = 0.001
UP = np.array([0.0, 0.0, 1.0])


def box(extents, at=(0, 0, 0)):
    return trimesh.creation.box(extents).apply_translation(at)


def joined(*meshes):
    return trimesh.util.concatenate(meshes)


BRACKET = joined(
    box([0.4, 0.2, 0.05], [0, 0, 0.025]),
    box([0.05, 0.2, 0.25], [-0.175, 0, 0.175]),
    box([0.1, 0.05, 0.1], [0.1, 0.05, 0.1]),
)
MIRRORED = BRACKET.copy().apply_transform(np.diag([1.0, -1, 1, 1]))
CRATE = box([0.3, 0.2, 0.25])
DRUM = trimesh.creation.cylinder(0.12, 0.3)


def model(name, mesh):
    own = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    return Model(name, *own, surface_of(*own))


@pytest.fixture(scope="module", autouse=True)
def fewer():
    """Points of a surface, which are made in less time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(surface, "DRAWN", 16_000)
        patch.setattr(surface, "KEPT", 4_000)
        yield


@pytest.fixture(scope="module")
def parts():
    meshes = {"bracket": BRACKET, "mirrored": MIRRORED, "crate": CRATE, "drum": DRUM}
    return {name: model(name, mesh) for name, mesh in meshes.items()}


@pytest.fixture(scope="module")
def known(parts):
    return Library(list(parts.values()))


def scan(mesh, seed=0, rotation=None):
    """What a noisy depth camera at `EYE` measures of a part, and the part's pose."""
    rng = np.random.default_rng(seed)
    pose = np.eye(4)
    turn = Rotation.random(random_state=rng) if rotation is None else rotation
    pose[:3, :3], pose[:3, 3] = turn.as_matrix(), rng.uniform(-0.1, 0.1, 3)
    scene = Scene(mesh.copy().apply_transform(pose))
    hits = scene.cast(EYE, camera_rays(scene, EYE).directions.reshape(-1, 3))
    some = rng.choice(len(hits.points), 3000)
    rays = hits.points[some] - EYE
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return hits.points[some] + NOISE * rng.normal(size=(3000, 1)) * rays, pose


def away(mesh, found, pose):
    """The farthest that the part's surface lies from where it is, in metres."""
    points = trimesh.sample.sample_surface(mesh, 2000, seed=1)[0]
    moved = trimesh.transform_points(points, np.linalg.inv(pose) @ found)
    return np.abs(trimesh.proximity.signed_distance(mesh, moved)).max()


@pytest.mark.parametrize(
    ("name", "mesh"), [("bracket", BRACKET), ("crate", CRATE), ("drum", DRUM)]
)
def test_a_part_is_found_in_its_pose(known, name, mesh):
    """Of a symmetric one, in any that looks the same."""
    points, pose = scan(mesh)
    found = known.find(points, EYE)
    assert found.model is not None and found.match is not None
    assert found.model.name == name
    assert away(mesh, found.match.pose, pose) < 0.004
    assert set(found.refused) == {"bracket", "mirrored", "crate", "drum"} - {name}
    _, sigma = found.placed()
    assert NOISE / 2 < np.median(sigma) < 3 * NOISE
    again = known.find(points, EYE)
    assert again.match.pose.tobytes() == found.match.pose.tobytes()
    assert again.refused == found.refused


def test_poses_near_the_true_one_become_it(parts):
    points, pose = scan(BRACKET)
    seen, surface = Scan(points, EYE), parts["bracket"].surface
    back = pose[:3, :3].T
    true = rigid(back, back @ (seen.middle - pose[:3, 3]) - surface.middle)
    rng = np.random.default_rng(0)
    turns = Rotation.from_rotvec(rng.normal(0, 0.03, (6, 3))).as_matrix()
    poses = rigid(turns, rng.normal(0, 0.008, (6, 3))) @ true
    refined, scores = refine(seen, surface, poses)
    assert len(refined) == 1 and scores[0] > 0.95
    np.testing.assert_allclose(refined[0], true, atol=0.005)
    found = evidence.match(seen, surface, refined[0])
    np.testing.assert_allclose(found.pose, pose, atol=0.002)
    np.testing.assert_allclose(found.poses(seen, surface)[0], true, atol=0.005)


def test_a_pose_that_one_face_does_not_tell_is_refused(parts):
    """Two faces tell it well enough, though they slide along their edge."""
    surface, rng, doubts = parts["crate"].surface, np.random.default_rng(0), []
    for axes in ([2], [1, 2]):
        points = rng.uniform(-0.5, 0.5, (1200, 3))
        points[np.arange(1200), rng.choice(axes, 1200)] = 0.5
        seen = Scan(points * CRATE.extents, EYE)
        pose = rigid(np.eye(3), seen.middle - surface.middle)
        told = evidence.match(seen, surface, pose).evidence._replace(covered=1.0)
        doubts.append(evidence.doubt(told))
    assert doubts == ["what was measured does not tell its pose", None]


def test_a_thin_plate_is_laid_on_the_side_that_faces_the_sensor():
    rng, plate = np.random.default_rng(0), box([0.4, 0.3, 0.004])
    points = rng.uniform(-0.5, 0.5, (2000, 3)) * plate.extents
    points[:, 2] = 0.002 + rng.normal(0, 0.0002, 2000)
    seen, surface = Scan(points, EYE), model("plate", plate).surface
    for aside in -0.003, 0.003:
        pose = rigid(np.eye(3), seen.middle - surface.middle + [0, 0, aside])
        found = evidence.match(seen, surface, pose)
        np.testing.assert_allclose(found.pose[2, 3], 0, atol=2e-4)


def test_of_a_thin_wall_the_right_side_is_measured():
    """Both sides of a tube are seen, one through its mouth."""
    tube = trimesh.creation.annulus(0.098, 0.1, 0.15)
    known = Library([model("tube", tube)])
    for seed in range(3):
        points, pose = scan(tube, seed)
        found = known.find(points, EYE)
        assert found.match is not None
        apart, axis = found.match.pose[:3, 3] - pose[:3, 3], pose[:3, 2]
        assert np.linalg.norm(np.cross(apart, axis)) < 0.0003


@pytest.mark.parametrize(("longer", "taken"), [(1.05, True), (1.1, False)])
def test_a_longer_part_reaches_where_nothing_is(longer, taken):
    points, _ = scan(CRATE)
    known = Library([model("crate", CRATE.copy().apply_scale([longer, 1, 1]))])
    visibility = seen_among(points, np.zeros((0, 3)), EYE, background="empty")
    assert (known.find(points, EYE, visibility).model is not None) == taken


def test_what_is_no_part_is_none(parts):
    points, _ = scan(BRACKET, rotation=Rotation.identity())
    others = Library([parts[name] for name in ("mirrored", "crate", "drum")])
    visibility = seen_among(points, np.zeros((0, 3)), EYE)
    found = others.find(points, EYE, visibility)
    assert found.model is None and len(found.refused) == 3


@pytest.mark.parametrize("change", ["moved", "missing"])
def test_a_part_that_was_changed_in_one_place_is_not_the_drawn_one(parts, change):
    """Little of it differs, but all in one place."""
    plate, wall, _ = BRACKET.split()
    boss = box([0.1, 0.05, 0.1], [0.1, 0.02, 0.1])
    other = joined(plate, wall, *([boss] if change == "moved" else []))
    points, _ = scan(other, rotation=Rotation.identity())
    visibility = seen_among(points, np.zeros((0, 3)), EYE)
    for mesh, name in ((BRACKET, "bracket"), (other, "other")):
        found = Library([model(name, mesh)]).find(points, EYE, visibility)
        assert (found.model is None) == (mesh is BRACKET), found.refused


def test_two_that_explain_it_equally_are_both_named(parts):
    points, _ = scan(CRATE)
    twin = dataclasses.replace(parts["crate"], name="twin")
    found = Library([parts["crate"], twin]).find(points, EYE)
    assert found.model.name == "crate" and found.equal == ("twin",)
    # Where they differ behind, where nobody has looked, it is neither.
    upright = Rotation.identity()
    points, _ = scan(CRATE, rotation=upright)
    hollow = box([0.3, 0.2, 0.25])
    hollow.update_faces(hollow.triangles_center[:, 0] > -0.1)
    found = Library([parts["crate"], model("open", hollow)]).find(points, EYE, up=UP)
    assert found.model is None
    assert found.refused["crate"] == "crate and open explain it equally well"


def test_a_part_is_followed_without_a_search_until_it_jumps(parts, monkeypatch):
    library_, searched, search = Library([parts["bracket"]]), [], library.search
    monkeypatch.setattr(library, "search", lambda *a: searched.append(1) or search(*a))
    points, _ = scan(BRACKET)
    found = library_.find(points, EYE)
    for shift, turn, searches in ((0.0, 0, 1), (0.005, 0, 1), (0.02, 120, 2)):
        turned = Rotation.from_euler("z", turn, degrees=True).as_matrix()
        moved, eye = (p @ turned.T + [shift, 0, 0] for p in (points, EYE))
        found = library_.find(moved, eye, before=found)
        assert found.model is parts["bracket"] and len(searched) == searches


def test_another_unit_is_named(parts):
    points, _ = scan(CRATE)
    found = Library([parts["crate"]]).find(points * 1000, EYE * 1000)
    assert (
        "about 1,000 times too small: if all are, check the units"
        in found.refused["crate"]
    )


def test_a_folder_is_read_once(tmp_path, monkeypatch):
    monkeypatch.setenv("PRISM_JAX_CACHE", str(tmp_path / "cache"))
    folder = tmp_path / "parts"
    (folder / "below").mkdir(parents=True)
    for name in ("below/crate.stl", "crate.ply", "crate.obj"):
        CRATE.copy().apply_scale(1000).export(folder / name)
    CRATE.export(folder / "crate.glb")
    with pytest.raises(InputError, match=r"crate\.stl: the unit .*--known_unit"):
        Library.from_folder(folder)
    first = Library.from_folder(folder, "mm")
    names = [model.name for model in first.models]
    assert names == ["below/crate.stl", "crate.glb", "crate.obj", "crate.ply"]
    for one in first.models:
        np.testing.assert_allclose(one.surface.size, 0.3, rtol=0.02)
    kept = sorted((tmp_path / "cache" / "models").iterdir())
    kept[0].write_bytes(b"damaged")
    kept[1].write_bytes(kept[1].read_bytes()[:1000])
    made, make = [], library.surface_of
    monkeypatch.setattr(library, "surface_of", lambda *m: made.append(1) or make(*m))
    second = Library.from_folder(folder, "mm")
    assert len(made) == 2
    for one, other in zip(first.models, second.models, strict=True):
        for name, ours in dataclasses.asdict(one.surface).items():
            theirs = getattr(other.surface, name)
            assert np.array_equal(ours, theirs)


def test_links_of_a_robot_are_models(tmp_path, monkeypatch, urdf):
    monkeypatch.setenv("PRISM_JAX_CACHE", str(tmp_path / "cache"))
    links = Library.from_folder(urdf.parent).models
    assert links and all(f"{urdf.name}:" in link.name for link in links)


@pytest.mark.parametrize("content", [None, b"solid nothing\nendsolid\n"])
def test_a_faulty_folder_is_told(tmp_path, content):
    if content is not None:
        (tmp_path / "part.stl").write_bytes(content)
    with pytest.raises(InputError, match=r"no models|not a readable mesh"):
        Library.from_folder(tmp_path, "m")
