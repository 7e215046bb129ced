"""The small robot made of boxes."""

from tests.experiments.simulation.roboarm.conftest import model, urdf

__all__ = ["model", "urdf"]
