"""Categories by title."""

import pytest

from experiments.simulation.objects.categories import (
    _WORDS,
    CATEGORIES,
    NO_OBJECTS,
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


def test_there_are_few_and_no_word_is_in_two():
    assert len(CATEGORIES) == len({*CATEGORIES}) <= 25
    assert not {*NO_OBJECTS} & {*CATEGORIES}
    words = [word for words in _WORDS.values() for word in words.split()]
    assert len(words) == len({*words})
