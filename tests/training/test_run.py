"""The log of a run."""

import json
import time

from prism_jax.training.run import Log


def written(folder):
    lines = (folder / "metrics.jsonl").read_text().splitlines()
    return [json.loads(line) for line in lines]


def test_log_lines(tmp_path, monkeypatch):
    """Readable while the run goes on."""
    now = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    log = Log(tmp_path, "seeds", total=64, step=2, batch_size=8)
    now[0] += 6.0
    log.advance(8)
    log.write(3, losses={"a": 0.5, "b": 0.25})
    now[0] += 2.0
    log.write(3, validation={"c": 1.0})
    first, second = written(tmp_path)
    log.close()
    place = {"phase": "seeds", "step": 3, "samples": 24}
    rate = {"samples_per_second": 1.33}
    assert first == place | rate | {"losses": {"a": 0.5, "b": 0.25}}
    assert second == place | {"samples_per_second": 1.0, "validation": {"c": 1.0}}


def test_going_on_drops_what_was_written_after_the_checkpoint(tmp_path):
    """Of this phase, and a line that was broken off."""
    for name, steps in (("seeds", (1, 2, 3)), ("stages", (9,))):
        log = Log(tmp_path, name, 80, step=0, batch_size=1)
        for step in steps:
            log.write(step, losses={"a": float(step)})
        log.close()
    with (tmp_path / "metrics.jsonl").open("a") as file:
        file.write('{"phase": "seeds", "st')
    Log(tmp_path, "seeds", 8, step=2, batch_size=1).close()
    left = [(line["phase"], line["step"]) for line in written(tmp_path)]
    assert left == [("seeds", 1), ("seeds", 2), ("stages", 9)]
