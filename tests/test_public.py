"""The public names."""

import inspect

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


def test_every_name_and_method_is_documented():
    for name in sorted(NAMES):
        value = getattr(prism_jax, name)
        documented = inspect.getdoc(value)
        # A dataclass without a docstring gets its signature for one.
        assert documented is not None and not documented.startswith(f"{name}("), name
        for key, method in vars(value).items() if inspect.isclass(value) else ():
            if key[0] != "_" and (callable(method) or isinstance(method, property)):
                assert inspect.getdoc(method), f"{name}.{key}"
