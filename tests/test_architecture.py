"""Imports point one way, and nothing unpickles what a user gives."""

import ast
import pathlib
import tomllib

ROOT = pathlib.Path(__file__).resolve().parents[1]

# From the top down: a module imports from its own line and from those below it.
LAYERS = (
    "experiments",
    "prism_jax",
    "prism_jax.cli",
    "prism_jax.streaming",
    "prism_jax.envelope",
    "prism_jax.robots",
    "prism_jax.reporting",
    "prism_jax.evaluation",
    "prism_jax.completion",
    "prism_jax.uncertainty",
    "prism_jax.training",
    "prism_jax.data",
    "prism_jax.adaptation",
    "prism_jax.models",
    "prism_jax.losses",
    "prism_jax.preprocessing",
    "prism_jax.io",
    "prism_jax.geometry",
    "prism_jax.assets",
)

# Where less is allowed than the order allows.
READING = {"prism_jax.preprocessing", "prism_jax.io", "prism_jax.geometry"}
ONLY = {
    "prism_jax.geometry": {"prism_jax.geometry"},
    "prism_jax.io": {"prism_jax.io", "prism_jax.geometry"},
    "prism_jax.preprocessing": READING,
    "prism_jax.data": READING | {"prism_jax.data", "prism_jax.assets"},
    "prism_jax.robots": {"prism_jax.robots", "prism_jax.io", "prism_jax.geometry"},
    "prism_jax.losses": {"prism_jax.losses", "prism_jax.geometry"},
    "prism_jax.adaptation": {
        "prism_jax.adaptation",
        "prism_jax.models",
        "prism_jax.losses",
        "prism_jax.geometry",
    },
}

NO_FLAX = (*READING, "prism_jax.losses", "prism_jax.data")
# Packages, and the parts that must not import some, wherever the import stands. What
# reads with one of the makers asks for it when it does (`io.errors.require`).
FORBIDDEN = {
    **dict.fromkeys(("flax", "optax", "orbax"), NO_FLAX),
    **dict.fromkeys(
        ("trimesh", "manifold3d", "embreex", "fpsample", "grain"), ("prism_jax",)
    ),
}
UNPICKLERS = {"pickle", "cPickle", "_pickle", "cloudpickle", "dill", "joblib", "shelve"}


def module_name(path):
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


TREES = {
    module_name(path): ast.parse(path.read_text())
    for package in ("prism_jax", "experiments")
    for path in sorted(ROOT.glob(f"{package}/**/*.py"))
}
"""Syntax trees of everything that is shipped."""


def imported(tree):
    """Every module that a file imports, wherever in it the import stands."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            for alias in node.names:
                inside = f"{node.module}.{alias.name}"
                yield inside if inside in TREES else node.module


def inside(name, package):
    return f"{name}.".startswith(f"{package}.")


def layer(name):
    """Index of the longest entry of LAYERS that the module lies in."""
    found = [
        entry
        for entry in LAYERS
        if name == entry or (entry != "prism_jax" and inside(name, entry))
    ]
    assert found, f"{name} has no place in LAYERS"
    return LAYERS.index(max(found, key=len))


def own(name):
    return name.split(".")[0] in ("prism_jax", "experiments")


def test_no_import_points_up():
    faults = []
    for name, tree in TREES.items():
        for target in filter(own, imported(tree)):
            if target not in TREES:
                faults.append(f"{name} imports {target}, which is not there")
            elif layer(name) > layer(target):
                faults.append(f"{name} imports {target}")
    assert not faults


def test_some_know_less_than_the_order_allows():
    faults = [
        f"{name} imports {target}"
        for package, known in ONLY.items()
        for name, tree in TREES.items()
        if inside(name, package)
        for target in filter(own, imported(tree))
        if ".".join(target.split(".")[:2]) not in known
    ]
    assert not faults


def test_adaptation_never_reaches_a_dataset():
    """Not through others either."""
    reached = {name for name in TREES if name.startswith("prism_jax.adaptation")}
    while True:
        further = {t for name in reached for t in imported(TREES[name]) if t in TREES}
        # What `import prism_jax` itself runs is another matter.
        further.discard("prism_jax")
        if further <= reached:
            break
        reached |= further
    assert not {n for n in reached if n.startswith("prism_jax.data")}
    assert "prism_jax.models.prism" in reached


def test_some_packages_are_not_imported_everywhere():
    assert len(TREES) > 200
    faults = [
        f"{name} imports {target}"
        for name, tree in TREES.items()
        for target in imported(tree)
        for package in FORBIDDEN.get(target.split(".")[0], ())
        if inside(name, package)
    ]
    assert not faults


def test_no_name_is_exported_twice():
    exports = []
    for name, tree in TREES.items():
        for node in tree.body if own(name) else ():
            if (
                isinstance(node, ast.Assign)
                and ast.unparse(node.targets[0]) == "__all__"
            ):
                exports += ast.literal_eval(node.value)
    assert len(exports) == len(set(exports)) > 14


def test_nothing_unpickles():
    assert not [name for name, tree in TREES.items() if unpickles(tree)]


def unpickles(tree):
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            settings = {k.arg: ast.unparse(k.value) for k in node.keywords}
            if settings.get("allow_pickle", "False") != "False":
                return True
            called = ast.unparse(node.func)
            if called == "torch.load" and settings.get("weights_only") != "True":
                return True
            if called in ("np.load", "numpy.load") and "allow_pickle" not in settings:
                return True
    return bool({t.split(".")[0] for t in imported(tree)} & UNPICKLERS)


def test_what_unpickles_is_found():
    for source in (
        *("import pickle", "from joblib import load", "np.load(path)"),
        *("np.load(path, allow_pickle=True)", "torch.load(path)"),
    ):
        assert unpickles(ast.parse(source)), source
    for source in (
        "torch.load(path, weights_only=True)",
        "np.load(path, allow_pickle=False)",
    ):
        assert not unpickles(ast.parse(source)), source


def test_the_wheel_takes_all_assets():
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())
    patterns = settings["tool"]["setuptools"]["package-data"]["prism_jax"]
    package = ROOT / "prism_jax"
    taken = {path for pattern in patterns for path in package.glob(pattern)}
    assert {path for path in (package / "assets").rglob("*") if path.is_file()} <= taken
