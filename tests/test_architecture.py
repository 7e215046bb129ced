"""Imports point one way, and nothing unpickles what a user gives."""

import ast
import pathlib
import tomllib

ROOT = pathlib.Path(__file__).resolve().parents[1]

# From the top down: a room imports from itself and from those below it. Above all are
# `experiments`, and then the package itself.
ROOMS = (
    *("cli", "streaming", "envelope", "reporting", "evaluation", "completion"),
    *("registration", "robots", "uncertainty", "training", "data", "adaptation"),
    *("models", "losses", "preprocessing", "io", "geometry", "assets"),
)

# Where less is allowed than the order allows.
ONLY = {
    "geometry": {"geometry"},
    "io": {"io", "geometry"},
    "preprocessing": {"preprocessing", "io", "geometry"},
    "data": {"data", "preprocessing", "io", "geometry", "assets"},
    "robots": {"robots", "io", "geometry"},
    "registration": {"registration", "robots", "preprocessing", "io", "geometry"},
    "losses": {"losses", "geometry"},
    "adaptation": {"adaptation", "models", "losses", "geometry"},
}
NO_FLAX = {"geometry", "io", "preprocessing", "losses", "data", "registration"}
LEARNING = {"flax", "optax", "orbax"}
# What reads with one of these asks for it when it does (`io.errors.require`).
MAKERS = {"trimesh", "manifold3d", "embreex", "fpsample", "grain"}
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


def room(name):
    """The part of a module that the order knows: a room, or what is above all."""
    package, *parts = name.split(".")
    return parts[0] if package == "prism_jax" and parts else package


def layer(name):
    return ["experiments", "prism_jax", *ROOMS].index(room(name))


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
    faults = []
    for name, tree in TREES.items():
        known = ONLY.get(room(name), {*ROOMS, "prism_jax", "experiments"})
        roots = {target.split(".")[0] for target in imported(tree)}
        if {room(t) for t in imported(tree) if own(t)} - known:
            faults.append(name)
        if name.startswith("prism_jax") and roots & MAKERS:
            faults.append(name)
        if room(name) in NO_FLAX and roots & LEARNING:
            faults.append(name)
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


def test_nothing_unpickles_but_what_only_the_program_itself_can_have_written():
    found = [name for name, tree in TREES.items() if unpickles(tree)]
    assert found == ["prism_jax.completion.compile_cache"]


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
