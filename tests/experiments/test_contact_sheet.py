"""The launcher: what it writes, and how it ends."""

import pytest
from PIL import Image

from experiments import contact_sheet
from tests import launching


def run(*arguments) -> int:
    """The command's exit status with these arguments."""
    return launching.run(contact_sheet, *arguments)


@pytest.mark.parametrize(
    "few", [["--category=mug", "--category=bowl"], ["--dataset=open", "--rows=2"]]
)
def test_a_sheet_has_a_labelled_row_of_pictures_each(few, tmp_path):
    output = tmp_path / "sheet.png"
    assert run(f"--output={output}", "--columns=1", "--seeds=2", "--size=32", *few) == 0
    with Image.open(output) as sheet:
        assert sheet.size == (2 * 32, 2 * (32 + 15))
        assert len(sheet.getcolors()) > 8


def test_what_cannot_be_written_ends_in_one_line(tmp_path, capsys):
    (tmp_path / "file").touch()
    output = tmp_path / "file" / "sheet.png"
    few = ["--category=mug", "--seeds=1", "--size=16"]
    assert run(f"--output={output}", *few) == 2
    assert "cannot be written" in capsys.readouterr().err
