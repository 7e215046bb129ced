"""Pictures of models."""

import numpy as np

from experiments.simulation.objects.pictures import credit, model_row
from experiments.simulation.objects.survey import survey


def test_a_row_shows_mesh_and_clouds(catalogue_dir):
    (model, _), _ = survey(["test"], catalogue_dir).models
    row = model_row(model, 0, 64)
    assert row.label == "Fridge"
    mesh, clouds = (picture.astype(int) for picture in row.pictures)
    assert mesh.shape == clouds.shape == (64, 64, 3)
    blue = clouds[..., 2] - clouds[..., 0]
    assert (blue > 60).mean() > 0.03 and (blue < -60).mean() > 0.03
    # The clouds stand where the mesh does.
    high, low = (
        np.flatnonzero((p < 250).all(axis=2).any(axis=1)) for p in (mesh, clouds)
    )
    assert abs(high[0] - low[0]) < 8


def test_credit_names_maker_and_licence(catalogue_dir):
    model = survey(["train"], catalogue_dir).models[1][0]
    told = "Locked locker by Bob (BlendSwap-CC-BY), CC BY 3.0, turned and scaled"
    assert credit(model) == told
