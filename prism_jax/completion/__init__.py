"""Scans in the user's frame and units, completed."""
