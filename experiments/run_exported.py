"""Completes scans with a function that experiments.export wrote. Needs JAX alone.

python run_exported.py adapt.jaxexport scans.npy completed.npy

Scans are (B, N, 3) or (N, 3), as many as the function takes, with their sensor at the
origin and z upwards, in any unit of length.
"""

import pathlib
import sys

import jax
import jax.export
import numpy as np

function, scans, output = sys.argv[1:]
exported = jax.export.deserialize(bytearray(pathlib.Path(function).read_bytes()))
points = np.load(scans, allow_pickle=False).astype(np.float32)
points = points.reshape(exported.in_avals[0].shape)
sensors = np.zeros(exported.in_avals[1].shape, np.float32)
completed = jax.jit(exported.call)(points, sensors)
np.save(output, completed["points"])
print("accepted:", *completed["accepted"])
