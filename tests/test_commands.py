"""Every command that README, notes and docs name can be given as it stands there."""

import pathlib
import re
import shlex

import pytest

from tests import launching

ROOT = pathlib.Path(__file__).parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/*.md")])
COMMAND = re.compile(
    r"(?:python -m experiments\.(\w+)|prism-(complete|stream|envelope)(?: [\w./]+)*)"
    r"((?:\s+--(?:\"[^\"]*\"|[^\s`\"])+)*)"
)
PLACEHOLDERS = {"$split": "train", "SUITE": "ops", "--network=NAME": "--network=pcn"}
WITHOUT_FLAGS = {"results"}


def commands() -> list[tuple[str, str]]:
    """Launchers and what follows them, in code blocks and in running text."""
    found = set()
    for page in PAGES:
        text = page.read_text().replace("\\\n", " ").replace("-->", "")
        for launcher, installed, rest in COMMAND.findall(text):
            found.add((launcher or installed, " ".join(rest.rstrip(";").split())))
    # Which stand for several.
    return sorted(c for c in found if "..." not in c[1] and "|" not in c[1])


COMMANDS = commands()
assert len(COMMANDS) > 35


@pytest.mark.parametrize(("launcher", "rest"), COMMANDS)
def test_its_flags_are_the_launchers(launcher, rest):
    if launcher in WITHOUT_FLAGS or rest == "--help":
        assert rest in ("", "--help")
        folder = "prism_jax/cli" if launcher in launching.INSTALLED else "experiments"
        assert (ROOT / folder / f"{launcher}.py").exists()
        return
    for placeholder, value in PLACEHOLDERS.items():
        rest = rest.replace(placeholder, value)
    launching.parse(launcher, *shlex.split(rest))


def test_flags_of_the_script_are_its_own_or_the_trainings():
    texts = (page.read_text().replace("\\\n", " ") for page in PAGES)
    given = [
        shlex.split(rest)
        for text in texts
        for rest in re.findall(r"train_release\.sh((?:\s+--[^\s`]+)+)", text)
    ]
    assert len(given) > 2
    script = (ROOT / "experiments" / "train_release.sh").read_text()
    own = re.findall(r"^    (--\w+=)\*\)", script, re.MULTILINE)
    own.remove("--preset=")
    for flags in given:
        assert not [flag for flag in flags if not flag.startswith("--")]
        others = [flag for flag in flags if not flag.startswith(tuple(own))]
        launching.parse("train", "--workdir=DIR", *others)
