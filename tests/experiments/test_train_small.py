"""The script that trains `small`: every command can be given, and is given once."""

from experiments.settings import resolve
from tests import launching


def test_every_command_in_order(scripted, tmp_path):
    place = f"--workdir={tmp_path}/run"
    assert scripted("train_small.sh", "--seed=3")[0] == 2
    status, told, commands = scripted("train_small.sh", place, "--seed=3")
    assert status == 0, told
    for name, *arguments in commands:
        launching.parse(name, *arguments)
        resolve("small", [x[6:] for x in arguments if x.startswith("--set=")])
    names = [command[0] for command in commands]
    assert names == 12 * ["make_data"] + 2 * ["pack"] + 2 * ["train"]
    pretrain, meta = map(set, commands[-2:])
    start = f"--weights={tmp_path}/run/pretrain/weights.safetensors"
    assert start in meta - pretrain and "--seed=3" in pretrain & meta
    # What is trained on or validated on has been made.
    made = {(c[1][13:], c[2][10:], *c[3:]) for c in commands if c[0] == "make_data"}
    assert (f"{tmp_path}/run/data", "cells", "--split=validation") in made
    again = scripted("train_small.sh", place)[2]
    assert {command[0] for command in again} == {"make_data", "pack"}
    place = f"--workdir={tmp_path}/other"
    status, told, commands = scripted("train_small.sh", place, stops="/pretrain ")
    assert status == 0 and "goes on, with more --max_steps or none" in told
    assert f"{place}/pretrain" in commands[-1]
