"""What a training writes down: lines of JSON, and the same numbers for TensorBoard."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from gvtools.training.records import TrainingLog, read_log


def scalars(folder: Path) -> dict[str, list[tuple[int, float]]]:
    """What TensorBoard shows of a stage: (step, value) by name."""
    pytest.importorskip("tensorboard", reason="the extra train is not installed")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(folder / "tensorboard"))
    events.Reload()
    return {
        name: [(event.step, event.value) for event in events.Scalars(name)]
        for name in events.Tags()["scalars"]
    }


def resumed(folder: Path, step: int) -> TrainingLog:
    """The log of a later process: TensorBoard orders files by the second of their making."""
    time.sleep(1.01)
    return TrainingLog(folder, step=step)


def test_tensorboard_has_the_numbers_of_the_log(tmp_path):
    log = TrainingLog(tmp_path)
    log.write(20, {"loss": 1.5, "rate": 0.25})
    log.write(40, {"loss": 0.75})
    assert scalars(tmp_path) == {"loss": [(20, 1.5), (40, 0.75)], "rate": [(20, 0.25)]}
    assert [record["loss"] for record in read_log(tmp_path)] == [1.5, 0.75]


def test_a_resumed_training_takes_back_the_steps_that_it_repeats(tmp_path):
    log = TrainingLog(tmp_path)
    for step in (20, 40, 60):
        log.write(step, {"loss": float(step)})
    # The last state was saved after step 40; step 60 is made again, and comes out otherwise.
    again = resumed(tmp_path, 40)
    again.write(60, {"loss": -60.0})
    again.write(80, {"loss": -80.0})
    assert scalars(tmp_path)["loss"] == [(20, 20.0), (40, 40.0), (60, -60.0), (80, -80.0)]
    assert [(r["step"], r["loss"]) for r in read_log(tmp_path)] == scalars(tmp_path)["loss"]


def test_a_resumed_training_that_repeats_nothing_keeps_everything(tmp_path):
    TrainingLog(tmp_path).write(20, {"loss": 1.0})
    resumed(tmp_path, 20).write(21, {"loss": 2.0})
    assert scalars(tmp_path) == {"loss": [(20, 1.0), (21, 2.0)]}


def test_the_log_does_without_tensorboard(tmp_path, monkeypatch):
    import gvtools.training.records as records

    monkeypatch.setattr(records, "_tensorboard", lambda folder, step: None)
    log = TrainingLog(tmp_path)
    log.write(1, {"loss": 1.0})
    assert read_log(tmp_path) == [{"step": 1, "loss": 1.0}]
    assert not (tmp_path / "tensorboard").exists()
