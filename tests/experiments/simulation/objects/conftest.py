"""Small catalogues of models, as Sweet Home 3D has them."""

import zipfile

import numpy as np
import pytest
import trimesh

from experiments.simulation.objects.catalogues import CATALOGUES


def knobbed(size=(1.0, 2.0, 0.5), knob=0.2) -> trimesh.Trimesh:
    """A box with a knob on its front, z, at the upper corner of its +x side; y up."""
    body = trimesh.creation.box(size)
    place = np.array(size) / 2 - (knob / 2, knob / 2, -knob / 2)
    return body + trimesh.creation.box((knob,) * 3).apply_translation(place)


def entry(name, mesh, title, **more):
    """A model as the writer takes it, in the size that it has: what the catalogue says
    of it, and its file, of which None is not written."""
    size = dict(zip(("width", "height", "depth"), mesh.extents, strict=True))
    own = {"model": f"/models/{name}/{name}.obj", "name": title, "creator": "Ann"}
    return {**own, **size, **more}, mesh.export(file_type="obj")


@pytest.fixture(scope="session")
def write_catalogue():
    """Writes an archive of models into a folder."""

    def write(folder, name, entries, head="version=1.8"):
        lines = ["# A catalogue", f"id=Models#{name}", head]
        path = folder / f"{name}.sh3f"
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            for number, (told, text) in enumerate(entries, start=1):
                lines += [f"{key}#{number}={value}" for key, value in told.items()]
                if text is not None:
                    archive.writestr(told["model"].lstrip("/"), text)
            properties = "\n".join(lines).encode("latin-1")
            archive.writestr("PluginFurnitureCatalog.properties", properties)
        return path

    return write


@pytest.fixture(scope="session")
def catalogue_dir(tmp_path_factory, write_catalogue):
    """All five catalogues, with models that are taken and some of every other kind."""
    folder = tmp_path_factory.mktemp("catalogues")
    ball = trimesh.creation.icosphere(2, radius=3.0)
    ring = trimesh.creation.torus(1.0, 0.4, 16, 8)
    cone = trimesh.creation.cone(0.5, 2.0).subdivide()
    models = {
        "Scopia": [
            entry("fridge", knobbed(), "Fridge"),
            entry("red-ball", ball, "Soccer ball"),
            entry("blue-ball", ball.copy().apply_scale(2.0), "Soccer ball"),
        ],
        "KatorLegaz": [
            entry("ring", ring, "Ring", creator="Kator Legaz"),
            entry("window", knobbed((1, 1, 0.4)), "Window", doorOrWindow="true"),
            entry("plug", knobbed((1, 1, 0.4)), "Wall plug"),
        ],
        "Reallusion": [entry("rug", trimesh.creation.box((2, 0.01, 3)), "Rug")],
        "BlendSwap-CC-0": [
            entry("cone", cone, "Cone"),
            entry("ball", ball, "Beach ball"),
            entry("panel", trimesh.creation.box((2, 3, 0.15)), "Panel"),
        ],
        "BlendSwap-CC-BY": [
            entry("locker", knobbed((1, 1, 1), 0.4), "Locked locker", creator="Bob"),
            (entry("bad", ball, "Vase")[0], "v 0 0 nan\nf 1 1 1\n"),
            (entry("sheet", ball, "Vase")[0], "v 0 0 0\nv 1 0 0\nv 0 1 1\nf 1 2 3\n"),
        ],
    }
    for known in CATALOGUES:
        write_catalogue(folder, known.name, models[known.name])
    return folder
