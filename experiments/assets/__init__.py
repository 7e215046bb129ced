"""Files that launchers and tests read, and that are too many for the package."""

import pathlib

CELLS = pathlib.Path(__file__).parent / "roboarm"
"""Recordings of 12 simulated robot cells: the first frames of 12 test sequences."""
