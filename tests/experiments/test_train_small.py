"""The script that says how `small` was trained: every command can be given."""

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
    trained = [set(command) for command in commands if command[0] == "train"]
    assert len(trained) == 11 and all("--seed=3" in command for command in trained)
    mixed = [[c for c in command if c.startswith("--mixture")] for command in trained]
    assert [len(found) for found in mixed] == 8 * [0] + 3 * [1]
    # Each goes on from what came before it.
    starts = [c[10:] for command in trained for c in command if c[:10] == "--weights="]
    ends = [f"{n:02}/weights.safetensors" for n in range(1, 9)]
    ends += ["small-occluded.safetensors", "small-longer.safetensors"]
    assert starts == [f"{tmp_path}/run/{end}" for end in ends]
    assert commands[-1][0] == "interpolate" and "--share=0.75" in commands[-1]
    again = scripted("train_small.sh", place)[2]
    assert {command[0] for command in again} == {"make_data", "pack"}
    place = f"--workdir={tmp_path}/other"
    status, told, commands = scripted("train_small.sh", place, stops="/04 ")
    assert status == 0 and "goes on, with more --max_steps or none" in told
    assert f"{place}/04" in commands[-1]
