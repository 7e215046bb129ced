"""Files that launchers and tests read, and that are too many for the package."""

import pathlib

CELLS = pathlib.Path(__file__).parent / "roboarm"
"""Recordings of 20 simulated robot cells: the first frame of each test sequence."""
