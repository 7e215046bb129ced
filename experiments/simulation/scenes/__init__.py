"""Scenes: two to eight things on a table or a floor (z = 0), seen by one sensor."""
