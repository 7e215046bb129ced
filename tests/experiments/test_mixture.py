"""Several sources as one."""

import collections

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


@pytest.mark.parametrize("weights", [[1, 1, 1], [1, 5, 2], [0.1, 0.1, 9.0]])
def test_each_has_its_share_and_every_item_comes(weights):
    mixed = Mixture([Named("a", 7), Named("b", 3), Named("c", 20)], weights)
    assert isinstance(mixed, Source)
    times = collections.Counter(example.name for example in mixed)
    assert len(times) == 60
    expected = np.array(weights) / np.sum(weights)
    np.testing.assert_allclose(mixed.shares, expected, atol=0.02)
    for key, share in zip("abc", mixed.shares, strict=True):
        own = [count for name, count in times.items() if name[0] == key]
        assert max(own) - min(own) <= 1
        assert sum(own) / len(mixed) == pytest.approx(share)


def test_objects_are_told_apart_and_follow_one_another():
    mixed = Mixture([Named("a", 10), Named("b", 2)], [1, 1])
    by_name = {}
    for index, number in enumerate(mixed.objects):
        source, row = mixed[index].name.split("/")
        by_name.setdefault((source, int(row) // 2), set()).add(int(number))
    assert all(len(numbers) == 1 for numbers in by_name.values())
    assert len(set.union(*by_name.values())) == 12
    assert (np.diff(mixed.objects) >= 0).all()
    assert mixed.categories == ("thing", "a", "b")
    assert mixed[-1].name == mixed[len(mixed) - 1].name
    with pytest.raises(IndexError):
        mixed[len(mixed)]


def test_what_the_flag_says():
    assert parse_mixture("shapes,open:2.5") == {"shapes": 1.0, "open": 2.5}
    for text in ("", "shapes:0", "shapes:-1", ":2", "a:1,a:2", "a:x", "a:nan", "a:inf"):
        with pytest.raises(InputError, match="--mixture"):
            parse_mixture(text)


def test_every_set_is_trained_on(monkeypatch):
    opened = []

    def open_named(name, split, data_dir):
        opened.append((name, split, data_dir))
        return Named(name, 6)

    monkeypatch.setattr(mixture, "open_dataset", open_named)
    train = open_mixture({"shapes": 1, "shapenet55": 3}, "here")
    assert opened == [("shapes", "train", "here"), ("shapenet55", "train", "here")]
    assert len(train) == 48 and train.shares.tolist() == [0.25, 0.75]
    with pytest.raises(InputError, match="shells"):
        open_mixture({"shells": 1})
