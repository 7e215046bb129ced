"""The public names."""

import ast
import inspect
import pathlib

import pytest

import prism_jax

NAMES = {
    "Camera",
    "Workspace",
    "render_depth",
    "knn",
    "nearest",
    "farthest_point_sample",
    "pca_normals",
    "sinkhorn",
    "chamfer",
    "f_score",
    "Completer",
    "load_pretrained",
    "make_adapt",
    "observe",
}


def test_all_is_what_was_promised():
    assert set(prism_jax.__all__) == NAMES
    assert len(prism_jax.__all__) == len(NAMES)


@pytest.mark.parametrize("name", sorted(NAMES))
def test_every_name_is_documented(name):
    documented = inspect.getdoc(getattr(prism_jax, name))
    assert documented is not None
    # A dataclass without a docstring gets its signature for one.
    assert not documented.startswith(f"{name}(")


@pytest.mark.parametrize("name", ["Camera", "Workspace", "Completer"])
def test_so_is_every_public_method(name):
    methods = [
        value
        for key, value in vars(getattr(prism_jax, name)).items()
        if not key.startswith("_") and (callable(value) or isinstance(value, property))
    ]
    assert methods
    for method in methods:
        assert inspect.getdoc(method)


def test_version():
    assert prism_jax.__version__.count(".") == 2


def test_no_name_is_exported_twice():
    package = pathlib.Path(prism_jax.__file__).parent
    exports = []
    for path in package.rglob("*.py"):
        for node in ast.parse(path.read_text()).body:
            if (
                isinstance(node, ast.Assign)
                and ast.unparse(node.targets[0]) == "__all__"
            ):
                exports += ast.literal_eval(node.value)
    assert set(exports) > NAMES
    assert len(exports) == len(set(exports))
