"""The launcher: what it writes, and how it ends."""

import sys

import pytest
from absl import flags
from PIL import Image

from experiments import contact_sheet

FLAGS = (
    *("dataset", "output", "split", "sequences", "category"),
    *("seed", "seeds", "columns", "size", "colors"),
)


def run(*arguments) -> int:
    """The command with these arguments; its exit status."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["contact_sheet", *arguments])
        try:
            with pytest.raises(SystemExit) as ended:
                contact_sheet.run()
        finally:
            # A process defines its flags once; these tests do so again and again.
            for name in FLAGS:
                delattr(flags.FLAGS, name)
    return ended.value.code or 0


def test_writes_one_row_a_category(tmp_path):
    output = tmp_path / "sheet.png"
    few = ["--category=mug", "--category=bowl", "--seeds=3", "--size=32"]
    assert run(f"--output={output}", "--columns=1", *few) == 0
    with Image.open(output) as sheet:
        assert sheet.size == (3 * 32, 2 * (32 + 15))
    before = output.read_bytes()
    assert run(f"--output={output}", "--columns=1", *few) == 0
    assert output.read_bytes() == before


def test_writes_one_row_a_robot_cell(tmp_path):
    output = tmp_path / "sheet.png"
    one = ["--dataset=roboarm", "--split=train", "--sequences=1", "--size=40"]
    assert run(f"--output={output}", "--columns=1", *one) == 0
    with Image.open(output) as sheet:
        assert sheet.size == (4 * 40, 40 + 15)


def test_a_folder_that_is_not_there_ends_in_one_line(tmp_path, capsys):
    output = tmp_path / "none" / "sheet.png"
    few = ["--category=mug", "--seeds=1", "--size=16"]
    assert run(f"--output={output}", *few) == 2
    assert "cannot be written" in capsys.readouterr().err
