"""A stand-in for `prism_jax.completion.completer` that completes in no time, and
badly."""

import numpy as np

from prism_jax.completion.assembly import CompletedScan, in_one_scene
from prism_jax.geometry.camera import Camera
from prism_jax.geometry.workspace import Workspace
from prism_jax.io import InputError
from prism_jax.preprocessing.segmentation.planes import Plane
from prism_jax.preprocessing.segmentation.scene import SUPPORT, SegmentedScene

LOSSES = ("objective", "depth_consistency", "normal", "denoise", "align")


class FakeCompleter:
    """Mirrors the cloud in its centre. A scene's objects are those beyond x = 10, 20,
    ..., and its support all points below z = 0."""

    @classmethod
    def from_pretrained(cls, name: str, quick: bool = False) -> "FakeCompleter":
        if name != "small":
            raise InputError(name, "no such weights", "choose one of small")
        return cls()

    def complete(
        self,
        points,
        camera=None,
        workspace=None,
        adapt=False,
        up="z",
        density=1.0,
        background="unknown",
        around=None,
    ):
        workspace = workspace or Workspace.from_points(points.astype(np.float64))
        prediction = 2 * workspace.center - points[::2]
        everything = np.concatenate([points, prediction.astype(points.dtype)])
        steps = 4 if adapt else 1
        mask = np.arange(128 * 128).reshape(128, 128) % 3 == 0
        depth = np.where(mask, 1.5, 0.0).astype(np.float32)
        return CompletedScan(
            points=everything,
            observed=np.arange(len(everything)) < len(points),
            prediction=prediction,
            left_out=0,
            left_away={"outside": 0, "stray": 1, "in_front": 2, "known": 3},
            accepted=adapt,
            losses={name: np.geomspace(1, 0.5, steps).tolist() for name in LOSSES},
            weights=np.array([0.5, 0.25, 0.25], np.float32),
            workspace=workspace,
            camera=camera or Camera.look_at(np.zeros(3), workspace.center),
            sensor="origin" if camera is None else "given",
            depth_observed=depth,
            mask_observed=mask,
            depth_completed=depth,
            mask_completed=~mask,
            seconds={"compile": 12.5, "run": 0.25},
            inside=np.ones(len(points), bool),
        )

    def knowing(self, library):
        return self

    def split_scene(self, points, camera=None, up="auto"):
        number = np.maximum(np.floor(points[:, 0] / 10).astype(int), 0)
        number = np.where(points[:, 2] < 0, SUPPORT, number)
        sizes = np.bincount(number[number >= 0]).tolist()
        support = int((number == SUPPORT).sum())
        planes = (Plane(np.array([0, 0, 1.0]), 0.0, 0.1),) if support else ()
        return SegmentedScene(number, planes, tuple(sizes), support, 0)

    def complete_scene(self, points, camera=None, *, scene, up="auto", **asked):
        objects = [
            self.complete(points[scene.object == i], camera, **asked)
            for i in range(len(scene.num_points))
        ]
        vertical = np.array([0.0, 0.0, 1.0])
        return in_one_scene(
            points, scene.object, objects, scene.planes, vertical, "support"
        )
