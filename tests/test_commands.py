"""Every command that README and BUILD_NOTES name can be given as it stands there."""

import pathlib
import re
import shlex

import pytest

from tests import launching

ROOT = pathlib.Path(__file__).parents[1]
COMMAND = re.compile(r"python -m experiments\.(\w+)((?:\s+--[^\s`]+)*)")
PLACEHOLDERS = {"$split": "train", "SUITE": "ops", "--network=NAME": "--network=pcn"}


def commands() -> list[tuple[str, str]]:
    """Launchers and what follows them, in code blocks and in running text."""
    found = []
    for name in ("README.md", "BUILD_NOTES.md"):
        text = (ROOT / name).read_text().replace("\\\n", " ")
        found += COMMAND.findall(text)
    found = {(launcher, " ".join(rest.rstrip(";").split())) for launcher, rest in found}
    # Which stand for several.
    return sorted(c for c in found if "..." not in c[1] and "|" not in c[1])


COMMANDS = commands()


def test_they_are_found():
    assert len(COMMANDS) > 35
    named = {launcher for launcher, _ in COMMANDS}
    assert {"complete", "evaluate", "make_data", "pretrain", "train_release"} <= named


@pytest.mark.parametrize(("launcher", "rest"), COMMANDS)
def test_its_flags_are_the_launchers(launcher, rest):
    for placeholder, value in PLACEHOLDERS.items():
        rest = rest.replace(placeholder, value)
    launching.parse(launcher, *shlex.split(rest))
