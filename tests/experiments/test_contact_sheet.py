"""The launcher: what it writes, and how it ends."""

from PIL import Image

from experiments import contact_sheet
from tests import launching
from tests.experiments.simulation.objects.conftest import catalogue_dir, write_catalogue

__all__ = ["catalogue_dir", "write_catalogue"]


def run(*arguments) -> int:
    """The command's exit status with these arguments."""
    return launching.run(contact_sheet, *arguments)


def test_writes_one_row_a_category(tmp_path):
    output = tmp_path / "sheet.png"
    few = ["--category=mug", "--category=bowl", "--seeds=3", "--size=32"]
    assert run(f"--output={output}", "--columns=1", *few) == 0
    with Image.open(output) as sheet:
        assert sheet.size == (3 * 32, 2 * (32 + 15))
    before = output.read_bytes()
    assert run(f"--output={output}", "--columns=1", *few) == 0
    assert output.read_bytes() == before


def test_writes_rows_of_open_shapes(tmp_path):
    output = tmp_path / "sheet.png"
    few = ["--dataset=open", "--rows=3", "--seeds=2", "--size=32"]
    assert run(f"--output={output}", *few) == 0
    with Image.open(output) as sheet:
        assert sheet.size == (2 * (2 * 32 + 4) - 4, 2 * (32 + 15))


def test_writes_one_row_a_kind_of_view(tmp_path):
    output = tmp_path / "sheet.png"
    few = ["--dataset=views", "--category=mug", "--size=32", "--columns=3"]
    assert run(f"--output={output}", *few) == 0
    with Image.open(output) as sheet:
        # Twelve kinds, a cloud and a map of each.
        assert sheet.size == (3 * (2 * 32 + 4) - 4, 4 * (32 + 15))
        assert len(sheet.getcolors()) > 4


def test_writes_one_row_a_scene(tmp_path):
    output = tmp_path / "sheet.png"
    two = ["--dataset=scenes", "--split=validation", "--scenes=2", "--size=40"]
    assert run(f"--output={output}", *two) == 0
    with Image.open(output) as sheet:
        assert sheet.size == (2 * (2 * 40 + 5) - 5, 40 + 15)
        assert len(sheet.getcolors()) > 10


def test_writes_one_row_a_robot_cell(tmp_path):
    output = tmp_path / "sheet.png"
    one = ["--dataset=roboarm", "--split=train", "--sequences=1", "--size=40"]
    assert run(f"--output={output}", "--columns=1", *one) == 0
    with Image.open(output) as sheet:
        assert sheet.size == (4 * 40, 40 + 15)


def test_writes_one_row_a_varied_cell(tmp_path):
    output = tmp_path / "sheet.png"
    # The first arm comes with example-robot-data.
    one = ["--dataset=cells", "--split=train", "--sequences=1", "--size=40"]
    assert run(f"--output={output}", "--columns=1", *one) == 0
    with Image.open(output) as sheet:
        assert sheet.size == (3 * 40, 40 + 15)
        assert len(sheet.getcolors()) > 8


def test_writes_one_row_a_model_and_prints_its_maker(tmp_path, catalogue_dir, capsys):
    output = tmp_path / "sheet.png"
    place = [f"--output={output}", f"--catalogue_dir={catalogue_dir}", "--columns=1"]
    assert run("--dataset=objects", "--models=2", "--size=40", *place) == 0
    with Image.open(output) as sheet:
        assert sheet.size == (2 * 40, 2 * (40 + 15))
    printed = capsys.readouterr().out
    assert "Fridge by Ann (Scopia), CC BY 3.0, turned and scaled" in printed
    assert "Locked locker by Bob (BlendSwap-CC-BY)" in printed


def test_what_cannot_be_written_ends_in_one_line(tmp_path, capsys):
    (tmp_path / "file").touch()
    output = tmp_path / "file" / "sheet.png"
    few = ["--category=mug", "--seeds=1", "--size=16"]
    assert run(f"--output={output}", *few) == 2
    assert "cannot be written" in capsys.readouterr().err
