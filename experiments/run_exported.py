"""Completes scans with a function that experiments.export wrote. Needs JAX and
flatbuffers.

python run_exported.py adapt.jaxexport scans.npy completed.npy

Scans are (B, N, 3) or (N, 3), of exactly as many points as the function takes, with
their sensor at the origin and z upwards, in any unit of length.
"""

import pathlib
import sys

import jax
import jax.export
import numpy as np

if len(sys.argv) != 4:
    sys.exit(f"usage: python {sys.argv[0]} FUNCTION.jaxexport SCANS.npy OUTPUT.npy")
function, scans, output = sys.argv[1:]
exported = jax.export.deserialize(bytearray(pathlib.Path(function).read_bytes()))
points = np.load(scans, allow_pickle=False).astype(np.float32)
shape = exported.in_avals[0].shape
if points.shape not in (shape, shape[1:] if shape[0] == 1 else shape):
    sys.exit(f"{scans}: has the shape {points.shape}; it must be {shape}")
points = points.reshape(shape)
sensors = np.zeros(exported.in_avals[1].shape, np.float32)
completed = jax.jit(exported.call)(points, sensors)
np.save(output, completed["points"])
if "objective" in completed:  # it adapts first
    print("accepted:", *completed["accepted"])
