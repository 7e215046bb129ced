"""A live view of completed frames by rerun (https://rerun.io)."""

import socket
import subprocess
import sys

import numpy as np

from prism_jax.io.errors import InputError, require
from prism_jax.io.ply import COLORS, COMPLETED, OBSERVED
from prism_jax.io.streams.sinks import Labelled

EXTRA = "view"
HOST = "127.0.0.1"
ARGUMENTS = ("--bind", HOST, "--memory-limit", "1GB", "--hide-welcome-screen")
"""Of rerun's viewer: nobody but this machine's programs can reach it."""


class RerunView:
    """A sink that shows frames in a window: measured and predicted points.

    ``path`` writes a recording for rerun instead, for machines without a screen.
    """

    def __init__(self, path: str | None = None):
        self._rerun = require("rerun", EXTRA)
        self._rerun.init("prism-stream")
        if path is not None:
            self._rerun.save(path)
            return
        with socket.socket() as free:
            free.bind((HOST, 0))
            port = free.getsockname()[1]
        command = [sys.executable, "-m", "rerun", "--port", str(port), *ARGUMENTS]
        try:
            subprocess.Popen(command, stdin=subprocess.DEVNULL, start_new_session=True)
        except OSError as error:
            fault = f"the viewer cannot be started ({error.strerror})"
            raise InputError("--view", fault, "leave it out") from None
        self._rerun.connect_grpc(f"rerun+http://{HOST}:{port}/proxy")

    def write(self, frame: Labelled) -> None:
        self._rerun.set_time("frame", sequence=frame.number)
        self._rerun.set_time("sensor", timestamp=1e-9 * frame.timestamp)
        clouds = {"observed": frame.observed, "completed": ~frame.observed}
        colors = {"observed": COLORS[OBSERVED], "completed": COLORS[COMPLETED]}
        for name, which in clouds.items():
            points = frame.points[which].astype(np.float32)
            cloud = self._rerun.Points3D(points, colors=[colors[name]])
            self._rerun.log(f"frame/{name}", cloud)

    def close(self) -> None:
        self._rerun.disconnect()
