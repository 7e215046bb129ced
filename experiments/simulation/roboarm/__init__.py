"""Simulated robot cells: arms from URDF on smooth paths, seen by simulated sensors."""
