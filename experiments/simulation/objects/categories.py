"""Coarse categories of models, from the words that catalogues use for them."""

import pathlib
import re
import tomllib

_WORDS = {
    category: words.split()
    for category, words in tomllib.loads(
        pathlib.Path(__file__).with_name("categories.toml").read_text()
    ).items()
}
NO_OBJECTS = {
    "wall_plate": "is a wall plate",
    "opening": "belongs to a door or a window",
}
"""What is left out, and how it is told."""
OTHER = "other"
CATEGORIES = (*(name for name in _WORDS if name not in NO_OBJECTS), OTHER)


def category_of(title: str) -> str:
    """One of `CATEGORIES` or of `NO_OBJECTS` by a model's English title: that of the
    longest known word or phrase in it, of two as long the first; else `OTHER`."""
    told = f"-{re.sub('[^a-z0-9]+', '-', title.lower())}-"
    found = [
        (len(word), category)
        for category, words in _WORDS.items()
        for word in words
        if f"-{word}-" in told
    ]
    return max(found, key=lambda pair: pair[0])[1] if found else OTHER
