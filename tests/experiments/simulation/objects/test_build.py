"""The models on disk, and as a source."""

import json

import numpy as np
import pytest

from experiments.simulation.build_dataset import build_dataset
from experiments.simulation.objects.build import ObjectsConfig, model_views
from experiments.simulation.objects.catalogues import CATEGORIES, PACKAGE
from experiments.simulation.objects.survey import survey
from prism_jax.data.datasets import folder_of, open_dataset
from tests.experiments.simulation.objects.conftest import entry, knobbed


@pytest.fixture(scope="module")
def built(catalogue_dir, tmp_path_factory):
    data_dir = tmp_path_factory.mktemp("built")
    settings = {"num_views": 2, "catalogue_dir": str(catalogue_dir)}
    build_dataset("objects", "train", data_dir, 0, **settings)
    return data_dir


def test_items_are_the_views_of_model_after_model(built, catalogue_dir):
    source = open_dataset("objects", "train", built)
    assert source.objects.tolist() == [0, 0, 1, 1]
    assert source.categories == CATEGORIES
    config = ObjectsConfig("train", 2)
    for number, (model, _) in enumerate(survey(["train"], catalogue_dir).models):
        partials, complete, eyes, *_ = model_views(config, model)
        for view in range(2):
            example = source[2 * number + view]
            np.testing.assert_array_equal(example.partial, partials[view])
            np.testing.assert_array_equal(example.complete, complete)
            np.testing.assert_array_equal(example.eye, eyes[view])
            assert example.name == f"{model.identity}/{view:02d}"
            assert example.ordered and not example.any_heading
    assert [source[0].category, source[2].category] == ["tool", "cabinet"]


def test_the_manifest_names_makers_and_what_is_left_out(built):
    told = json.loads(
        (folder_of("objects", "train", built) / "manifest.json").read_text()
    )
    assert told["package"] == PACKAGE
    assert [known["version"] for known in told["catalogues"]] == ["1.8", "1.8"]
    cone, locker = told["models"]
    assert cone["licence"] == "CC0 1.0" and locker["licence"] == "CC BY 3.0"
    assert (locker["creator"], locker["title"]) == ("Bob", "Locked locker")
    assert (locker["catalogue"], locker["name"]) == ("BlendSwap-CC-BY", "locker")
    assert len(cone["digest"]) == 12
    assert told["left_out"]["BlendSwap-CC-0/panel"] == "is a slab"


def test_a_models_clouds_follow_from_itself_and_the_seed(
    catalogue_dir, tmp_path, write_catalogue
):
    fridge = entry("fridge", knobbed(), "Fridge")
    other = entry("tower", knobbed((1, 5, 1)), "Tower")
    write_catalogue(tmp_path, "Scopia", [other, fridge])
    (_, (alone, _)), ((among, _), _) = (
        survey(["test"], folder).models for folder in (tmp_path, catalogue_dir)
    )
    first, again, reseeded = (
        model_views(ObjectsConfig("test", seed=seed), model)
        for seed, model in ((0, alone), (0, among), (1, alone))
    )
    for array, same in zip(first, again, strict=True):
        np.testing.assert_array_equal(array, same)
    # What kind of views they are does not hang on the seed.
    for array, differs in zip(first[:3], reseeded[:3], strict=True):
        assert not np.array_equal(array, differs)
