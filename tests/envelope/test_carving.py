"""Free space on random scenes: nothing that is there is in it."""

import numpy as np
import pytest
from scipy import ndimage

from prism_jax.envelope.carving import Carving, carve, view_of_cloud, view_of_depth
from prism_jax.envelope.voxels import Grid
from prism_jax.geometry.camera import Camera

BODY, MARGIN = 0.06, 0.04


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
                return _of_quadric((rays**2).sum(1), rays @ away, away @ away, radius)
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
    """Whether around each point's line of sight a ring of measured rays went on, too
    narrow for a body of `BODY` to fit in."""
    directions = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    length = np.linalg.norm(rays, axis=-1)
    passed = np.zeros(len(points), bool)
    for number, point in enumerate(points):
        away = np.linalg.norm(point - eye)
        cosine = directions @ ((point - eye) / away)
        bad = np.pad(~(measured * length > away), 1, constant_values=True)
        bad[1:-1, 1:-1] |= ~np.isfinite(measured)
        piece, _ = ndimage.label(bad, np.ones((3, 3)))
        at = np.unravel_index(cosine.argmax(), cosine.shape)
        own = piece[at[0] : at[0] + 3, at[1] : at[1] + 3]
        names = set(own[own > 0])
        step = min(
            np.linalg.norm(np.diff(directions, axis=axis), axis=-1).max()
            for axis in (0, 1)
        )
        side = max(int(BODY / np.sqrt(2) / away / step + 0.1), 1)
        fits = [
            ndimage.binary_erosion(piece == n, np.ones((side, side))).any()
            for n in names
        ]
        passed[number] = not any(fits) and piece[0, 0] not in names
    return passed


@pytest.mark.parametrize("seed", range(12))
def test_nothing_is_in_free_space(seed):
    found, _ = occupied(seed)
    assert not found
