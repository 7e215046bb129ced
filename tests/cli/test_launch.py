"""What every command shares."""

from experiments import evaluate, train
from tests.launching import run


def test_an_output_that_is_no_json_is_refused(tmp_path, capsys):
    path = tmp_path / "new" / "scores.md"
    assert run(evaluate, f"--output={path}") == 2
    message = capsys.readouterr().err.splitlines()[-1]
    assert message.endswith("scores.md is not a .json file; use the suffix .json")
    assert not path.parent.exists()


def test_what_is_no_flag_is_refused(capsys):
    """And not dropped, as absl has it after the first of several values."""
    words = "--workdir=w", "--set", "meta.num_samples=64", "adapt.seed=1"
    assert run(train, *words) == 2
    wanted = "train: adapt.seed=1: not a flag; write flags as --name=value"
    assert capsys.readouterr().err.splitlines()[-1] == wanted
