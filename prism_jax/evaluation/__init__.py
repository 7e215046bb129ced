"""Scores of anything that completes clouds, on any data set."""
