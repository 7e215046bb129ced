"""What prism-envelope writes of a scan, and of the frames of a recording."""

import dataclasses
import json
import os
import pathlib
from typing import Any

import numpy as np

from prism_jax import io
from prism_jax.envelope.files import distances_summary, envelope_files
from prism_jax.io.errors import unwritable
from prism_jax.preprocessing.upright import upright
from prism_jax.reporting.summary import plain
from prism_jax.streaming.enveloper import MadeEnvelope

LINES = "envelope.jsonl"  # of a recording, a line a frame


@dataclasses.dataclass
class Output:
    """A sink: a line for each frame as it comes, and all files of the last, or of each.
    Until it is closed the lines' file ends in `.part.jsonl`."""

    folder: pathlib.Path
    about: dict[str, Any]  # what the JSON says of all envelopes
    source: str
    every_frame: bool
    last: MadeEnvelope | None = None

    @property
    def _part(self) -> pathlib.Path:
        return self.folder / LINES.replace(".", ".part.")

    def write(self, frame: MadeEnvelope) -> None:
        summary = self._summary(frame)
        named = "frame_id points volumes q query reference known not_completed seconds"
        line = {"frame": frame.number, "timestamp": frame.timestamp}
        line |= {name: summary[name] for name in named.split()}
        try:
            with open(self._part, "w" if self.last is None else "a") as file:
                file.write(json.dumps(line, allow_nan=False) + "\n")
        except OSError as error:
            raise unwritable(self._part, error) from None
        self.last = frame
        if self.every_frame:
            own = io.make_output_dir(self.folder / f"{frame.number:06d}")
            self.write_files(own, frame)

    def close(self) -> None:
        if self.last is None:
            return self._part.unlink(missing_ok=True)
        if not self.every_frame:
            self.write_files(self.folder, self.last)
        os.replace(self._part, self.folder / LINES)

    def write_files(self, folder: pathlib.Path, made: MadeEnvelope) -> dict[str, Any]:
        """All files of one envelope; returns what its JSON says."""
        turn = upright(made.scan.up)
        vertical = np.array([0.0, 0.0, 1.0]) if turn is None else turn[2]
        summary = self._summary(made)
        about = summary, made.scan.named, vertical, made.query
        files = envelope_files(made.envelope, *about)
        io.write_together({folder / name: data for name, data in files.items()})
        return summary

    def _summary(self, made: MadeEnvelope) -> dict[str, Any]:
        grid, query = made.envelope.grid, made.query
        surfaces = made.envelope.surfaces.points
        frame = {"frame": made.number, "timestamp": made.timestamp}
        own = made.envelope.surfaces.part_margin if len(surfaces["part"]) else None
        return plain(
            {
                **self.about,
                "input": {
                    "file": self.source,
                    "points": len(made.scan.points),
                    **({} if made.number is None else frame),
                },
                "frame_id": made.scan.frame_id,
                "not_completed": made.seen.fault,
                "grid": {"lower": grid.lower, "voxel": grid.voxel, "shape": grid.shape},
                "points": {kind: len(cloud) for kind, cloud in surfaces.items()},
                "volumes": made.envelope.volumes(),
                "query": None if query is None else distances_summary(query[1]),
                "reference": made.shown,
                "known": made.known,
                "part_margin": own,
                "seconds": made.seconds,
            }
        )
