"""Categories by title."""

import pytest

from experiments.simulation.objects.categories import (
    OTHER,
    category_of,
)


@pytest.mark.parametrize(
    ("title", "category"),
    [
        ("Chair", "chair"),
        ("Baby high chair", "chair"),
        ("Sofa 3 seats", "sofa"),
        ("Captain's bed", "bed"),
        ("Bedside table", "cabinet"),
        ("Glass table", "table"),
        ("Glass", "kitchenware"),
        ("Sunglasses", "clothing"),
        ("Fork lift", "vehicle"),
        ("Table fan", "appliance"),
        ("Car model", "toy"),
        ("Carpet", OTHER),
        ("Rounded type E plug", "wall_plate"),
        ("Garage door", "opening"),
        ("Glass door cabinet", "cabinet"),
        ("", OTHER),
    ],
)
def test_the_longest_known_words_decide(title, category):
    assert category_of(title) == category
