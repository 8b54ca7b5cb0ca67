"""The resumable sweep: jobs that leave a record each, run in turn, side by side or on a cluster.

What decides a job's result is its identity. A job with a record of the same identity is done.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from functools import partial
from typing import Any, Generic, Protocol, TypeVar

Work = TypeVar("Work")
Record = dict[str, Any]

# Statuses of a record. One that failed has a ``reason``, and ``again`` where another attempt helps.
DONE, FAILED = "done", "failed"
# Longest wait for a job to end, seconds: then another one may have come.
WAIT_S = 1.0


def difference(record: Mapping[str, Any], identity: Mapping[str, Any]) -> str | None:
    """The first part of an identity that a record has otherwise; None where all are equal."""
    return next((key for key, value in identity.items() if record.get(key) != value), None)


def lost_worker(reason: str) -> Record:
    """The record of a job whose worker could not write one; it may be run again."""
    return {"status": FAILED, "reason": reason, "again": True}


@dataclass(frozen=True, eq=False)
class Job(Generic[Work]):
    """Work, and what is known of it."""

    work: Work
    record: Record | None = None  # of an earlier sweep; None has to run
    chain: str | None = None  # jobs of one chain run in their order, and none after a failure
    retries: int = 0  # attempts after the first


class Pool(Protocol):
    """Where jobs run."""

    slots: float
    """Jobs at a time."""

    def submit(self, work: Any, attempt: int) -> Any:
        """Begin a job; returns a handle."""

    def finished(self, handles: Sequence[Any]) -> list[tuple[Any, Record]]:
        """Handles of jobs that ended, with their records; waits for one at most ``WAIT_S``."""

    def close(self) -> None:
        """Release the workers."""


class InTurn:
    """One job at a time, in this thread."""

    slots = 1.0

    def __init__(self, run: Callable[[Any], Record]) -> None:
        self._run = run

    def submit(self, work: Any, attempt: int) -> Callable[[], Record]:
        """The job, which runs when its end is asked for."""
        return partial(self._run, work)

    def finished(
        self, handles: Sequence[Callable[[], Record]]
    ) -> list[tuple[Callable[[], Record], Record]]:
        """Run the job."""
        return [(handle, handle()) for handle in handles]

    def close(self) -> None:
        """Nothing is held."""


class Threads:
    """Several jobs at a time, each waited for by a thread; ``run`` takes a job and its attempt."""

    def __init__(self, run: Callable[[Any, int], Record], slots: int) -> None:
        self._run, self.slots = run, float(slots)
        self._pool = ThreadPoolExecutor(slots)

    def submit(self, work: Any, attempt: int) -> Future[Record]:
        """Begin a job."""
        return self._pool.submit(self._run, work, attempt)

    def finished(self, handles: Sequence[Future[Record]]) -> list[tuple[Future[Record], Record]]:
        """See Pool."""
        ended, _ = wait(handles, timeout=WAIT_S, return_when=FIRST_COMPLETED)
        return [(handle, _result(handle)) for handle in ended]

    def close(self) -> None:
        """Start no other job, and wait for those that run."""
        self._pool.shutdown(cancel_futures=True)


def _result(handle: Future[Record]) -> Record:
    try:
        return handle.result()
    except Exception as error:
        return lost_worker(f"{type(error).__name__}: {error}")


# What happens to a job: an earlier sweep has done it; its turn has come; an attempt failed and
# another one follows; it is done or given up; one before it in its chain failed.
FOUND, BEGUN, AGAIN, ENDED, SKIPPED = "found", "begun", "again", "ended", "skipped"


@dataclass(frozen=True, eq=False)
class Event(Generic[Work]):
    """A step of a sweep."""

    kind: str  # one of the above
    job: Job[Work]
    record: Record  # of the attempt, or the earlier sweep; empty where there is none
    attempt: int  # from 1
    after: Job[Work] | None = None  # of a skipped job, the one that failed


def sweep(
    jobs: Sequence[Job[Work]],
    pool: Pool,
    *,
    admit: Callable[[Job[Work]], bool] = lambda job: True,
) -> Generator[Event[Work], None, None]:
    """Run the jobs without a record, each up to its ``retries`` times again.

    A job that is not admitted when its turn has come is left out, with the rest of its chain.
    """
    chains: dict[object, deque[Job[Work]]] = {}
    for job in jobs:
        chains.setdefault(job if job.chain is None else job.chain, deque()).append(job)
    ready = deque((chain[0], 1) for chain in chains.values())
    running: dict[Any, tuple[Job[Work], int]] = {}

    def proceed(job: Job[Work]) -> None:
        chain = chains[job if job.chain is None else job.chain]
        chain.popleft()
        if chain:
            ready.append((chain[0], 1))

    try:
        while ready or running:
            while ready and len(running) < pool.slots:
                job, attempt = ready.popleft()
                if job.record is not None:
                    yield Event(FOUND, job, job.record, attempt)
                    proceed(job)
                elif admit(job):
                    yield Event(BEGUN, job, {}, attempt)
                    running[pool.submit(job.work, attempt)] = job, attempt
            for handle, record in pool.finished(list(running)) if running else ():
                job, attempt = running.pop(handle)
                if record.get("status") != FAILED:
                    yield Event(ENDED, job, record, attempt)
                    proceed(job)
                elif record.get("again") and attempt <= job.retries:
                    yield Event(AGAIN, job, record, attempt)
                    ready.append((job, attempt + 1))
                else:
                    yield Event(ENDED, job, record, attempt)
                    for later in list(chains[job if job.chain is None else job.chain])[1:]:
                        kind = SKIPPED if later.record is None else FOUND
                        yield Event(kind, later, later.record or {}, 0, job)
    finally:
        pool.close()


def records_of(works: Iterable[Work], run: Callable[[Work], Record]) -> list[Record]:
    """The records of jobs that are run in turn, whatever earlier sweeps left."""
    events = sweep([Job(work) for work in works], InTurn(run))
    return [event.record for event in events if event.kind == ENDED]
