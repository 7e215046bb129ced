"""Scenes taken apart into objects."""
