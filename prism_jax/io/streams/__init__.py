"""Frames of sensors from what people have on disk, a class a format."""

from prism_jax.io.streams.frame import Frame, Stream
from prism_jax.io.streams.opening import open_stream

__all__ = ["Frame", "Stream", "open_stream"]
