"""The plan from nothing to weights: its order, and how it goes on. The commands are
fakes; those of `tiny` were run by hand, as they take minutes."""

import json
import subprocess
import sys
from types import SimpleNamespace

import pytest

from experiments import train_release
from prism_jax.data.datasets import open_dataset
from prism_jax.simulation.building import write_manifest
from prism_jax.weights import file_sha256
from tests import launching


class Commands:
    """Takes the commands in; each writes its file, but for those that fail or stop."""

    def __init__(self):
        self.run, self.fails, self.stops, self.status = [], set(), set(), 3

    def __call__(self, command, check):
        assert command[:2] == [sys.executable, "-m"]
        arguments = dict(part.partition("=")[::2] for part in command[3:])
        places = ("--workdir", "--output", "--output_dir")
        place = next(arguments[name] for name in places if name in arguments)
        self.run.append((command[2], command[3:]))
        step = (command[2].removeprefix("experiments."), place.rpartition("/")[2])
        if step in self.fails:
            return subprocess.CompletedProcess(command, self.status)
        if step not in self.stops:
            self._write(command[2], place, arguments)
        return subprocess.CompletedProcess(command, 0)

    def _write(self, module, place, arguments):
        folder = train_release.pathlib.Path(place)
        if module == "experiments.evaluate":
            scored = {"weights_sha256": file_sha256(arguments["--weights"])}
            folder.write_text(json.dumps(scored))
        elif module == "experiments.release":
            (folder / f"{arguments['--name']}.safetensors").write_text("")
        else:
            folder.mkdir(exist_ok=True)
            (folder / "config.json").write_text("{}")
            (folder / "weights.safetensors").write_text(f"{len(self.run)}")


@pytest.fixture
def opened():
    """What is scored on, as it was built and opened before the first command."""
    return []


@pytest.fixture
def commands(monkeypatch, opened):
    fake = Commands()

    def note(*place):
        opened.append(place)

    monkeypatch.setattr(train_release, "subprocess", SimpleNamespace(run=fake))
    monkeypatch.setattr(train_release, "build_if_missing", note)
    monkeypatch.setattr(train_release, "open_dataset", note)
    return fake


MODULES = ["pretrain", *["meta_train"] * 2, *[*["evaluate"] * 3, "release"] * 2]
"""Of a plan for shapes without further branches."""


def modules(commands, start=0) -> list[str]:
    """Of the commands that were run, the first `start` left out."""
    return [name.removeprefix("experiments.") for name, _ in commands.run[start:]]


def run(*arguments) -> int:
    """The command's exit status with these arguments."""
    return launching.run(train_release, *arguments)


def test_the_plan_in_order(commands, tmp_path):
    changes = ["--set=meta.num_samples=64", "--data_dir=/data"]
    assert run("--preset=tiny", f"--workdir={tmp_path}", "--seed=4", *changes) == 0
    assert modules(commands) == MODULES
    for (_, arguments), module in zip(commands.run, MODULES, strict=True):
        launching.parse(module, *arguments)
        assert module == "release" or "--data_dir=/data" in arguments
    pretrain, meta, control, *_ = (arguments for _, arguments in commands.run)
    for arguments in (pretrain, meta, control):
        assert {"--preset=tiny", "--seed=4", changes[0]} <= set(arguments)
    start = f"--weights={tmp_path}/pretrained/weights.safetensors"
    assert start in meta and start in control
    # The control is the same run, but for the method.
    own = {f"--set={change}" for change in train_release.WITHOUT_METHOD}
    other = {f"--workdir={tmp_path}/{name}" for name in ("meta", "control")}
    assert set(meta) ^ set(control) == own | other
    names = [a for m, args in commands.run if "release" in m for a in args]
    assert "--name=tiny" in names and "--name=tiny-pretrained" in names
    assert (tmp_path / "tiny.safetensors").exists()


def test_it_goes_on_from_other_weights(commands, tmp_path):
    """The first training does; the others go on from the first."""
    given = (f"--workdir={tmp_path}/run", f"--weights={tmp_path}/before.safetensors")
    assert run("--preset=tiny", *given) == 2
    (tmp_path / "before.safetensors").write_text("")
    assert run("--preset=tiny", *given) == 0
    pretrain, meta, control, *_ = (arguments for _, arguments in commands.run)
    assert given[1] in pretrain
    assert given[1] not in meta and given[1] not in control


def test_goes_on_where_it_failed(commands, tmp_path):
    commands.fails.add(("meta_train", "control"))
    assert run("--preset=tiny", f"--workdir={tmp_path}") == 3
    assert len(commands.run) == 3
    commands.fails.clear()
    (tmp_path / "control").mkdir()
    (tmp_path / "control" / "config.json").write_text("{}")
    assert run("--preset=tiny", f"--workdir={tmp_path}") == 0
    again = commands.run[3]
    assert f"--workdir={tmp_path}/control" in again[1] and "--resume" in again[1]
    assert len(commands.run) == 3 + 9
    assert run("--preset=tiny", f"--workdir={tmp_path}", "--note=new") == 0
    assert modules(commands, 3 + 9) == ["release", "release"]
    assert all("--note=new" in arguments for _, arguments in commands.run[3 + 9 :])


@pytest.mark.parametrize(
    ("flag", "told"),
    [
        ("--seed=7", "seed is 0, not 7"),
        ("--set=meta.num_samples=64", "config.preset.meta.num_samples is 128, not 64"),
        ("--dataset=roboarm", "config.dataset is shapes, not roboarm"),
        ("--weights=small", "config.start is None, not"),
    ],
)
def test_it_goes_on_as_it_was_begun_alone(commands, tmp_path, capsys, flag, told):
    given = ("--preset=tiny", f"--workdir={tmp_path}")
    assert run(*given) == 0
    assert run(*given, flag) == 2
    assert modules(commands) == MODULES
    assert told in capsys.readouterr().err


def test_scores_of_weights_that_are_no_more_are_made_anew(commands, tmp_path):
    given = ("--preset=tiny", f"--workdir={tmp_path}")
    assert run(*given) == 0
    (tmp_path / "meta" / "weights.safetensors").unlink()
    assert run(*given) == 0
    again = ["meta_train", *["evaluate"] * 3, "release", "release"]
    assert modules(commands, len(MODULES)) == again


def test_a_killed_command_is_told_of(commands, tmp_path, capsys):
    commands.fails, commands.status = {("meta_train", "meta")}, -9
    assert run("--preset=tiny", f"--workdir={tmp_path}") == 128 + 9
    assert "stopped by SIGKILL; for want of memory?" in capsys.readouterr().out
    commands.fails = set()
    assert run("--preset=tiny", f"--workdir={tmp_path}") == 0


def test_so_many_are_scored_at_once(commands, tmp_path):
    assert run("--preset=tiny", f"--workdir={tmp_path}", "--scored_at_once=2") == 0
    scored = [part for module, part in commands.run if module.endswith("evaluate")]
    assert scored and all("--batch_size=2" in arguments for arguments in scored)


def test_a_bounded_run_stops_and_says_so(commands, tmp_path, capsys):
    commands.stops.add(("pretrain", "pretrained"))
    assert run("--preset=tiny", f"--workdir={tmp_path}", "--max_steps=5") == 0
    assert len(commands.run) == 1
    assert "--max_steps=5" in commands.run[0][1]
    assert "goes on, with more --max_steps or none" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ("no.field=1", "no field 'no'"),
        ("meta.num_samples=4", "meta: 4 samples do not fill a batch of 8"),
    ],
)
def test_a_mistake_shows_before_anything_runs(
    commands, tmp_path, capsys, change, fault
):
    assert run("--preset=tiny", f"--workdir={tmp_path}/run", f"--set={change}") == 2
    assert not commands.run and not [*tmp_path.iterdir()]
    assert fault in capsys.readouterr().err


@pytest.mark.parametrize(
    ("flags", "fault"),
    [
        (["--dataset=packed"], "train: is not built; pack it"),
        (["--dataset=recordings"], "recordings: has no split with ground truth"),
        (["--dataset=pcn"], "no such file"),
    ],
)
def test_so_does_a_set_that_could_not_be_scored(
    commands, tmp_path, capsys, monkeypatch, flags, fault
):
    monkeypatch.setattr(train_release, "open_dataset", open_dataset)
    given = ["--preset=tiny", f"--workdir={tmp_path}", f"--data_dir={tmp_path}"]
    assert run(*given, *flags) == 2
    assert not commands.run
    assert fault in capsys.readouterr().err


def test_what_was_trained_on_a_mixture_is_scored_on_its_parts(commands, tmp_path):
    parts = ["--scored=shapes", "--scored=roboarm"]
    folder = tmp_path / "mixture" / "train"
    folder.mkdir(parents=True)
    sources = {"sources": {"shapes": 1, "roboarm": 1}, "files": {}}
    write_manifest(folder, sources)
    mixture = ["--dataset=packed", f"--data_dir={folder.parent}", *parts]
    assert run("--preset=tiny", f"--workdir={tmp_path}/run", *mixture) == 0
    for _, arguments in commands.run[:3]:
        assert "--dataset=packed" in arguments and not set(parts) & set(arguments)
    found = [set(args) for m, args in commands.run if "evaluate" in m]
    assert len(found) == 2 * 5
    for arguments in found:
        assert f"--data_dir={folder.parent}" in arguments
        assert ("--dataset=shapes" in arguments) != ("--dataset=roboarm" in arguments)
    scores = [a for _, args in commands.run for a in args if a.startswith("--scores")]
    assert len(set(scores)) == 2 * 5


def test_nothing_is_built_among_the_users_own_data(commands, opened, tmp_path):
    given = ["--dataset=recordings", "--data_dir=cells", "--scored=roboarm"]
    assert run("--preset=tiny", f"--workdir={tmp_path}/a", *given) == 0
    splits = ("validation", "test")
    places = [("roboarm", split, None) for split in splits for _ in "ab"]
    assert opened == places
    for module, arguments in commands.run:
        is_training = module.endswith("train")
        assert ("--data_dir=cells" in arguments) == is_training
    opened.clear()
    assert (
        run("--preset=tiny", f"--workdir={tmp_path}/b", *given, "--scored_dir=x") == 0
    )
    assert opened == [(name, split, "x") for name, split, _ in places]
    scored = [args for name, args in commands.run[-6:] if name.endswith("evaluate")]
    assert scored and all("--data_dir=x" in arguments for arguments in scored)


def test_branches_alone(commands, tmp_path):
    flags = ["--branches=align", "--branches=normal,align", "--note=upright"]
    assert run("--preset=tiny", f"--workdir={tmp_path}", *flags) == 0
    meta, _, align, both = (args for m, args in commands.run if "meta_train" in m)
    for name, kinds, arguments in (
        ("align", ("align",), align),
        ("normal-align", ("normal", "align"), both),
    ):
        own = {f"--set=meta.method.branches={kinds}"}
        workdirs = {f"--workdir={tmp_path}/{n}" for n in ("meta", f"meta-{name}")}
        assert set(meta) ^ set(arguments) == own | workdirs
        assert (tmp_path / f"tiny-{name}.safetensors").exists()
    releases = [args for m, args in commands.run if "release" in m]
    assert len(releases) == 4 and all("--note=upright" in args for args in releases)


def test_no_such_branch(commands, tmp_path, capsys):
    given = (f"--workdir={tmp_path}", "--branches=align,normals")
    assert run("--preset=tiny", *given) == 2
    assert not commands.run
    assert "normals" in capsys.readouterr().err


def test_robots_have_no_unseen_split(commands, tmp_path):
    assert run(f"--workdir={tmp_path}", "--dataset=roboarm", "--name=arms") == 0
    splits = {a for _, args in commands.run for a in args if "--split" in a}
    assert splits == {"--split=validation", "--split=test"}
    assert (tmp_path / "arms-pretrained.safetensors").exists()
