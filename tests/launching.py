"""Commands run within the tests' own process."""

import sys
from types import ModuleType

import pytest
from absl import app, flags


def run(command: ModuleType, *arguments: str) -> int:
    """The launcher's exit status with these arguments."""
    app.define_help_flags()
    known = set(flags.FLAGS)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", [command.__name__, *arguments])
        # Which would start the tests anew.
        patch.setattr(command, "with_kept_pages", lambda: None, raising=False)
        try:
            with pytest.raises(SystemExit) as ended:
                command.run()
        finally:
            # A process defines its flags once; these tests do so again and again.
            for name in set(flags.FLAGS) - known:
                delattr(flags.FLAGS, name)
    return ended.value.code or 0
