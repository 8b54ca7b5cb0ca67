"""The resumable sweep, beside what the tests of fleets and trade-offs show of it."""

from __future__ import annotations

import pytest

from pipelines.scoring.sweep import BEGUN, ENDED, FAILED, FOUND, SKIPPED, InTurn, Job, sweep

FAILS = {"status": FAILED, "reason": "wrong"}


def test_a_failed_job_skips_the_rest_of_its_chain_but_what_is_there():
    jobs = [Job(1, chain="a"), Job(2, chain="a"), Job(3, {"status": "done"}, chain="a"), Job(4)]
    pool = InTurn(lambda work: FAILS if work == 1 else {})
    events = [(event.kind, event.job.work) for event in sweep(jobs, pool)]
    assert events == [(BEGUN, 1), (ENDED, 1), (SKIPPED, 2), (FOUND, 3), (BEGUN, 4), (ENDED, 4)]


@pytest.mark.parametrize("ending", ["error", "leaving"])
def test_workers_are_released_however_a_sweep_ends(ending, monkeypatch):
    def run(work):
        raise ValueError(work)

    pool, closed = InTurn(run), []
    monkeypatch.setattr(pool, "close", lambda: closed.append(True))
    events = sweep([Job(1)], pool)
    assert next(events).kind == BEGUN
    if ending == "error":
        with pytest.raises(ValueError, match="1"):
            next(events)
    events.close()
    assert closed == [True]
