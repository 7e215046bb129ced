"""The real catalogues, where they are installed."""

import pytest

from experiments.simulation.objects.catalogues import (
    CATALOGUES,
    FOLDER,
    PACKAGE,
    read_installed,
)
from experiments.simulation.objects.categories import CATEGORIES, OTHER, category_of
from experiments.simulation.objects.survey import fault_of

pytestmark = pytest.mark.skipif(
    not FOLDER.is_dir(), reason=f"the Debian package {PACKAGE} is not installed"
)


@pytest.fixture(scope="module")
def models():
    return [model for known in CATALOGUES for model in read_installed(known)[1]]


def test_all_models_are_told_apart_and_by_somebody(models):
    assert len({model.identity for model in models}) == len(models) >= 820
    assert all(model.creator and model.title for model in models)
    assert sum(model.fault is not None for model in models) >= 30


def test_most_have_a_category_and_every_category_has_some(models):
    found = [category_of(model.title) for model in models if model.fault is None]
    assert {*CATEGORIES} <= {*found}
    assert found.count(OTHER) < 0.1 * len(found)


def test_one_of_each_catalogue_can_be_loaded(models):
    for known in CATALOGUES:
        model = next(m for m in models if m.catalogue == known.name and not m.fault)
        assert fault_of(model.load()) is None or model.fault
