"""Public data sets in their published layouts, each a Source of Examples.

Nothing is downloaded: a set is put in place by whoever has the right to it. A set that
is not laid out as published, or not whole, is refused when it is opened.
"""

import functools
import inspect
import os
from collections.abc import Callable, Mapping
from typing import Any

from prism_jax.data.public.completion3d import Completion3D
from prism_jax.data.public.kitti import KITTI
from prism_jax.data.public.meshes import Meshes
from prism_jax.data.public.mvp import MVP
from prism_jax.data.public.pcn import PCN
from prism_jax.data.public.shapenet import ProjectedShapeNet, ShapeNet
from prism_jax.data.source import Source
from prism_jax.io.errors import InputError, choose

PUBLIC_SETS: Mapping[str, Callable[..., Source]] = {
    "shapenet55": functools.partial(ShapeNet, "ShapeNet-55"),
    "shapenet34": functools.partial(ShapeNet, "ShapeNet-34"),
    "shapenet_unseen21": functools.partial(ShapeNet, "ShapeNet-Unseen21"),
    "projected_shapenet55": functools.partial(ProjectedShapeNet, "ShapeNet-55"),
    "projected_shapenet34": functools.partial(ProjectedShapeNet, "ShapeNet-34"),
    "projected_shapenet_unseen21": functools.partial(
        ProjectedShapeNet, "ShapeNet-Unseen21"
    ),
    "pcn": PCN,
    "completion3d": Completion3D,
    "mvp": MVP,
    "kitti": KITTI,
    "meshes": Meshes,
}
"""Loaders by the name that flags use."""


def open_public(
    name: str, root: str | os.PathLike, split: str, **options: Any
) -> Source:
    """Opens a public set that lies under `root` in its published layout.

    `options` are the loader's own, such as ShapeNet's `difficulty` or MVP's
    `num_points`. A name, split or option that there is not, and a set that is not
    whole, raise InputError.
    """
    loader = PUBLIC_SETS[choose("data set", name, PUBLIC_SETS)]
    known = tuple(inspect.signature(loader).parameters)[2:]
    for option in options:
        if option not in known:
            fault = f"is no option of {name}"
            raise InputError(option, fault, f"it has {' '.join(known) or 'none'}")
    return loader(root, split, **options)
