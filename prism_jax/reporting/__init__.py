"""The HTML reports of completed scans and scenes: each one file without a network."""

from prism_jax.reporting.scan import render_report
from prism_jax.reporting.scene import render_scene_report

__all__ = ["render_report", "render_scene_report"]
