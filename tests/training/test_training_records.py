"""What a training writes down."""

from __future__ import annotations

from gvtools.training.records import TrainingLog, read_log


def test_a_resumed_training_takes_back_the_steps_that_it_repeats(tmp_path):
    log = TrainingLog(tmp_path)
    for step in (20, 40, 60):
        log.write(step, {"loss": float(step)})
    # The last state was saved after step 40; step 60 is made again, and comes out otherwise.
    again = TrainingLog(tmp_path, step=40)
    again.write(60, {"loss": -60.0})
    (tmp_path / "log.jsonl").open("a").write('{"step": 80, "lo')  # killed while writing
    records = [(record["step"], record["loss"]) for record in read_log(tmp_path)]
    assert records == [(20, 20.0), (40, 40.0), (60, -60.0)]
