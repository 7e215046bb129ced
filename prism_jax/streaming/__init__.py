"""Frames of a sensor completed one after the other, at its rate."""
