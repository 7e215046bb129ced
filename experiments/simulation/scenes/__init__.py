"""Scenes: two to eight things on a table or a floor, seen by one sensor.

Metres, z up, what things stand on at z = 0.
"""
