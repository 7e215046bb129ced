"""The launcher: what it writes, and how it ends."""

import pytest
from PIL import Image

from experiments import contact_sheet
from tests import launching


@pytest.mark.parametrize(
    "few", [["--category=mug", "--category=bowl"], ["--dataset=open", "--rows=2"]]
)
def test_a_sheet_has_a_labelled_row_of_pictures_each(few, tmp_path, capsys):
    output = tmp_path / "sheet.png"
    given = f"--output={output}", "--columns=1", "--seeds=1", "--size=32"
    assert launching.run(contact_sheet, *given, *few) == 0
    with Image.open(output) as sheet:
        assert sheet.size == (32, 2 * (32 + 15))
        assert len(sheet.getcolors()) > 8
    assert launching.run(contact_sheet, f"--output={output / 'sheet.png'}") == 2
    assert "cannot be written" in capsys.readouterr().err
