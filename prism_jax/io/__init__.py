"""Files to arrays and back: point clouds, depth images, cameras."""

from prism_jax.io.atomic import make_output_dir, write_together
from prism_jax.io.clouds import read_points
from prism_jax.io.depth import (
    camera_from_dict,
    camera_to_dict,
    points_from_depth,
    read_camera,
    read_depth,
)
from prism_jax.io.errors import InputError
from prism_jax.io.files import MAX_POINTS
from prism_jax.io.ply import ply_bytes
from prism_jax.io.scan import Bounds, Scan, parse_bounds, parted, read_scan

__all__ = [
    "MAX_POINTS",
    "Bounds",
    "InputError",
    "Scan",
    "camera_from_dict",
    "camera_to_dict",
    "make_output_dir",
    "parse_bounds",
    "parted",
    "ply_bytes",
    "points_from_depth",
    "read_camera",
    "read_depth",
    "read_points",
    "read_scan",
    "write_together",
]
