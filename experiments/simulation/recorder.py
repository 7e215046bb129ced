"""Writes recorded frames in the layout that `prism_jax.data.recordings` reads."""

import io
import json
import os
import pathlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from PIL import Image

from prism_jax.data.recordings import DEPTH_SCALE, NEEDED, OPTIONAL, RecordedFrame
from prism_jax.io.atomic import make_output_dir, write_bytes
from prism_jax.io.depth import camera_to_dict
from prism_jax.io.ply import ply_bytes


def write_frame(folder: str | os.PathLike, number: int, frame: RecordedFrame) -> None:
    """Writes a frame into a sequence's folder, in the place of one that is there; its
    camera, and so the frame, last."""
    path = make_output_dir(folder) / f"{number:06d}"
    for suffix in NEEDED + OPTIONAL:
        path.with_suffix(f".{suffix}").unlink(missing_ok=True)
    write_bytes(path.with_suffix(".depth.png"), _png(frame.depth))
    write_bytes(path.with_suffix(".partial.ply"), ply_bytes(frame.partial))
    if frame.complete is not None:
        write_bytes(path.with_suffix(".complete.ply"), ply_bytes(frame.complete))
    if frame.labels is not None:
        write_bytes(path.with_suffix(".labels.png"), _png(frame.labels))
    if frame.joints is not None:
        write_bytes(path.with_suffix(".joints.json"), _json(frame.joints))
    camera = camera_to_dict(frame.camera) | {"depth_scale": DEPTH_SCALE}
    write_bytes(path.with_suffix(".camera.json"), _json(camera))


def has_frame(folder: str | os.PathLike, number: int) -> bool:
    """Whether a frame was written to its end."""
    return pathlib.Path(folder, f"{number:06d}.camera.json").exists()


def _png(pixels: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "PNG", optimize=True)
    return buffer.getvalue()


def _json(entries: Mapping[str, Any]) -> bytes:
    return (json.dumps(entries, indent=1) + "\n").encode()
