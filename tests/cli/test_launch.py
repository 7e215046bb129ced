"""What every command shares."""

import pytest

from experiments import evaluate, train
from tests.launching import run


def test_an_output_that_is_no_json_is_refused(tmp_path, capsys):
    path = tmp_path / "new" / "scores.md"
    assert run(evaluate, f"--output={path}") == 2
    message = capsys.readouterr().err.splitlines()[-1]
    assert message.endswith("scores.md is not a .json file; use the suffix .json")
    assert not path.parent.exists()


@pytest.mark.parametrize(
    ("command", "arguments"),
    [
        (evaluate, ["small", "--split=test"]),
        (train, ["--workdir=w", "--set", "meta.num_samples=64", "adapt.seed=1"]),
    ],
)
def test_what_is_no_flag_is_refused(capsys, command, arguments):
    """And not dropped, as absl has it after the first of several values."""
    stray = next(word for word in reversed(arguments) if "--" not in word)
    assert run(command, *arguments) == 2
    name = command.__name__.rpartition(".")[2]
    wanted = f"{name}: {stray}: not a flag; write flags as --name=value"
    assert capsys.readouterr().err.splitlines()[-1] == wanted
