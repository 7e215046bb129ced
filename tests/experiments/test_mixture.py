"""Several sources as one."""

import numpy as np
import pytest

from experiments import mixture
from experiments.mixture import Mixture, open_mixture, parse_mixture
from prism_jax.data.source import Example, Source
from prism_jax.io.errors import InputError


class Named:
    """Objects with two views each, whose names say where they are from."""

    def __init__(self, name, objects):
        self.name, self.objects = name, np.repeat(np.arange(objects), 2)
        self.categories = ("thing", name)

    def __len__(self):
        return len(self.objects)

    def __getitem__(self, index):
        row = range(len(self))[index]
        return Example(None, None, None, self.name, f"{self.name}/{row}")


def names(source):
    return [source[index].name for index in range(len(source))]


def counted(source):
    found, counts = np.unique(names(source), return_counts=True)
    return dict(zip(found.tolist(), counts.tolist(), strict=True))


def test_each_has_its_share_and_every_item_comes():
    mixed = Mixture([Named("a", 50), Named("b", 5)], [3.0, 1.0])
    assert isinstance(mixed, Source)
    times = counted(mixed)
    assert len(times) == 110
    own = {key: [n for name, n in times.items() if name[0] == key] for key in "ab"}
    assert set(own["a"]) == {1}
    assert max(own["b"]) - min(own["b"]) <= 1
    np.testing.assert_allclose(mixed.shares, [0.75, 0.25], atol=0.01)
    assert sum(own["b"]) / len(mixed) == pytest.approx(mixed.shares[1])


@pytest.mark.parametrize("weights", [[1, 1, 1], [1, 5, 2], [0.1, 0.1, 9.0]])
def test_none_is_left_out_whatever_the_weights(weights):
    sources = [Named("a", 7), Named("b", 3), Named("c", 20)]
    mixed = Mixture(sources, weights)
    assert len(counted(mixed)) == 60
    expected = np.array(weights) / np.sum(weights)
    np.testing.assert_allclose(mixed.shares, expected, atol=0.02)


def test_sizes_as_weights_put_them_one_after_another():
    sources = [Named("a", 3), Named("b", 4)]
    mixed = Mixture(sources, [6, 8])
    assert names(mixed) == names(sources[0]) + names(sources[1])
    assert mixed.objects.tolist() == [0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 5, 5, 6, 6]
    assert mixed.categories == ("thing", "a", "b")


def test_objects_are_told_apart_and_follow_one_another():
    mixed = Mixture([Named("a", 10), Named("b", 2)], [1, 1])
    by_name = {}
    for index, number in enumerate(mixed.objects):
        source, row = mixed[index].name.split("/")
        by_name.setdefault((source, int(row) // 2), set()).add(int(number))
    assert all(len(numbers) == 1 for numbers in by_name.values())
    assert len(set.union(*by_name.values())) == 12
    assert (np.diff(mixed.objects) >= 0).all()


def test_places_are_those_of_a_sequence():
    mixed = Mixture([Named("a", 2), Named("b", 1)], [4, 2])
    assert mixed[-1].name == mixed[len(mixed) - 1].name
    with pytest.raises(IndexError):
        mixed[len(mixed)]


def test_what_the_flag_says():
    assert parse_mixture("shapes:1,open:2.5") == {"shapes": 1.0, "open": 2.5}
    assert parse_mixture("shapes") == {"shapes": 1.0}


@pytest.mark.parametrize(
    "text",
    ["", "shapes:0", "shapes:-1", ":2", "a:1,a:2", "a:x", "a:nan", "a:inf"],
)
def test_what_it_cannot_say(text):
    with pytest.raises(InputError, match="--mixture"):
        parse_mixture(text)


def test_every_set_is_trained_on_and_validated_where_it_can_be(monkeypatch):
    opened = []

    def open_named(name, split, data_dir):
        opened.append((name, split, data_dir))
        return Named(name, 6)

    monkeypatch.setattr(mixture, "open_dataset", open_named)
    monkeypatch.setattr(
        mixture, "validation_rows", lambda name, data_dir, count: Named(name, count)
    )
    train, validation = open_mixture({"shapes": 1, "shapenet55": 1}, "here", 4)
    assert opened == [("shapes", "train", "here"), ("shapenet55", "train", "here")]
    assert len(train) == 24
    assert names(validation) == [f"shapes/{row}" for row in range(8)]
    with pytest.raises(InputError, match="validation split"):
        open_mixture({"shapenet55": 1})
    with pytest.raises(InputError, match="shells"):
        open_mixture({"shells": 1})
