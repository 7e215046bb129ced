"""Files that ship with the package: weights, scans, the report's page."""

import pathlib


def asset(name: str) -> pathlib.Path:
    """The path of a file or folder that is installed with the package."""
    return pathlib.Path(__file__).parent / name
