"""Ouster's recordings of its LiDARs: PCAP with its metadata beside it, and OSF."""

import pathlib
from collections.abc import Iterator
from typing import Any

import numpy as np

from prism_jax.io.errors import InputError, require
from prism_jax.io.streams.frame import Frame, Stream, Tell, chosen_topic


class OusterStream(Stream):
    """Sweeps of an Ouster as clouds in the sensor's frame, x forward and z up, first
    returns only. A PCAP needs the sensor's metadata, a JSON of the same name beside it.
    Of several sensors the topic chooses one, by its serial number."""

    def __init__(self, path: pathlib.Path, topic: str | None, tell: Tell | None):
        super().__init__(path, tell)
        self._sdk = require("ouster.sdk", "ouster")
        self._core = require("ouster.sdk.core", "ouster")
        source = self._open()
        names = [str(info.sn) for info in source.sensor_info]
        self.topic = chosen_topic(path, topic, names, "sweeps")
        self._place = names.index(self.topic)
        self._count = len(source)
        source.close()

    def __len__(self) -> int:
        return self._count

    def _frames(self) -> Iterator[Frame]:
        source = self._open()
        try:
            to_xyz = self._core.XYZLut(source.sensor_info[self._place])
            for number, sweeps in enumerate(source):
                sweep = sweeps[self._place]
                if sweep is None:
                    continue
                if not sweep.complete():
                    seen = np.count_nonzero(np.asarray(sweep.status) & 1)
                    lost = f"{sweep.w - seen} of {sweep.w} columns"
                    line = f"sweep {number} is missing {lost}; the rest is used"
                    self.remark("incomplete", line)
                hit = np.asarray(sweep.field("RANGE")) > 0
                yield Frame(
                    points=to_xyz(sweep)[hit].astype(np.float32),
                    timestamp=int(sweep.get_first_valid_packet_timestamp()),
                    frame_id="os_sensor",
                )
        finally:
            source.close()

    def _open(self) -> Any:
        try:
            return self._sdk.open_source(self.path, index=True)
        except Exception as error:  # the SDK raises errors of many kinds
            fault = str(error).rpartition("more details:")[2].strip()
            fault = f"not a readable Ouster recording ({fault})"
            remedy = "add the sensor's metadata as a .json of the same name"
            raise InputError(self.path, fault, remedy) from None
