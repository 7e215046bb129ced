"""Frames of sensors from what people have on disk, a class a format."""

from prism_jax.io.streams.frame import Frame, Joints, Stream
from prism_jax.io.streams.opening import is_stream, open_stream

__all__ = ["Frame", "Joints", "Stream", "is_stream", "open_stream"]
