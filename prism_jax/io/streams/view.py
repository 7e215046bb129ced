"""A live view of completed frames by rerun (https://rerun.io)."""

import os
import socket
import subprocess
import sys

import numpy as np

from prism_jax.io.errors import InputError, require
from prism_jax.io.ply import COLORS, COMPLETED, KNOWN, OBSERVED
from prism_jax.io.streams.sinks import Labelled

EXTRA = "view"
HOST = "127.0.0.1"
ARGUMENTS = ("--bind", HOST, "--memory-limit", "1GB", "--hide-welcome-screen")
"""Of rerun's viewer: nobody but this machine's programs can reach it."""


QUIET = {"CI": "1"}
"""Where this is set, rerun sends no statistics of its use."""


class RerunView:
    """A sink that shows frames in a window: measured and predicted points,
    and those of a known robot.

    The window stays when the stream ends. When it is closed before, the stream goes on
    without it. Where there is no screen an InputError says so. ``path`` writes a file
    for rerun instead. The viewer is told to send nothing about its use to its makers.
    """

    def __init__(self, path: str | os.PathLike | None = None):
        self._rerun = require("rerun", EXTRA)
        self._viewer: subprocess.Popen | None = None
        screens = ("DISPLAY", "WAYLAND_DISPLAY")
        is_linux = sys.platform.startswith("linux")
        if path is None and is_linux and not any(map(os.environ.get, screens)):
            remedy = "leave it out, or start this where there is one"
            raise InputError("--view", "there is no screen", remedy)
        self._rerun.init("prism-stream")
        if path is not None:
            self._rerun.save(os.fspath(path))
            return
        with socket.socket() as free:
            free.bind((HOST, 0))
            port = free.getsockname()[1]
        command = [sys.executable, "-m", "rerun", "--port", str(port), *ARGUMENTS]
        try:
            self._viewer = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                start_new_session=True,
                env=os.environ | QUIET,
            )
        except OSError as error:
            fault = f"the viewer cannot be started ({error.strerror})"
            raise InputError("--view", fault, "leave it out") from None
        self._rerun.connect_grpc(f"rerun+http://{HOST}:{port}/proxy")

    def write(self, frame: Labelled) -> None:
        if self._is_gone():
            return
        self._rerun.set_time("frame", sequence=frame.number)
        self._rerun.set_time("sensor", timestamp=1e-9 * frame.timestamp)
        names = {OBSERVED: "observed", COMPLETED: "completed", KNOWN: "robot"}
        for label, name in names.items():
            if label == KNOWN and not (frame.label == KNOWN).any():
                continue
            points = frame.points[frame.label == label].astype(np.float32)
            cloud = self._rerun.Points3D(points, colors=[COLORS[label]])
            self._rerun.log(f"frame/{name}", cloud)

    def close(self) -> None:
        if not self._is_gone():
            self._rerun.disconnect()

    def _is_gone(self) -> bool:
        """Whether the window was closed."""
        return self._viewer is not None and self._viewer.poll() is not None
