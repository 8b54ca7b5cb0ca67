"""What readers make of damaged and hostile files: exact data or one named error, and no more.

Inputs that once failed are kept in ``tests/corpus`` and judged again here; the whole table, 10,000
mutations of each reader, is ``python -m hostile`` (docs/robustness.md).
"""

from __future__ import annotations

import mmap
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hostile import judge
from hostile.__main__ import CORPUS, FFMPEG, corpus, lines, slug
from hostile.judge import FAILED, OTHER, REFUSED, SAME, Bench, limited
from hostile.mutations import Mutation, Special
from hostile.readers import READERS, Reader, data_sets

from gvtools.errors import ProjectError

ROOT = Path(__file__).parents[2]
# Beside the corpus a few mutations of every reader, so that the table itself is known to work.
A_FEW = 1


def replayed(reader: Reader, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in FFMPEG.items():
        monkeypatch.setenv(name, value)
    bench = Bench(reader, folder)
    with limited():
        cases = [*corpus(reader.name), *map(bench.mutation, range(A_FEW))]
        verdicts = [bench.judge(case) for case in cases]
    assert [verdict.why for verdict in verdicts if verdict.outcome == FAILED] == []


# Those that read dear samples, weights and USD, are judged by the table and tests of their own.
@pytest.mark.parametrize("reader", [r for r in READERS if r.share >= 0.1], ids=lambda r: r.name)
def test_what_once_failed_is_read_or_refused(reader, tmp_path, monkeypatch):
    replayed(reader, tmp_path / "bench", monkeypatch)


@pytest.mark.slow
def test_layouts_and_dear_samples_that_once_failed_are_read_or_refused(tmp_path, monkeypatch):
    for reader in (*(r for r in READERS if r.share < 0.1), *data_sets()):
        if lines(CORPUS, reader.name):
            replayed(reader, tmp_path / slug(reader.name), monkeypatch)


def test_the_corpus_belongs_to_readers_and_is_small():
    known = {slug(reader.name) for reader in (*READERS, *data_sets())}
    files = list(CORPUS.glob("*.jsonl"))
    assert {file.stem for file in files} <= known
    assert sum(file.stat().st_size for file in files) < 500_000


# --- the judge itself -------------------------------------------------------------------------


def bench(tmp_path: Path, read: Any, **more: Any) -> Bench:
    """Of a sample that is one text file with a number."""

    def make(root: Path) -> None:
        (root / "n.txt").write_text("1.5\n")

    return Bench(Reader("tried", make, read, **more), tmp_path)


@pytest.fixture(autouse=True)
def _unwatched():
    yield
    judge._watched.clear()


def number(root: Path) -> dict[str, Any]:
    """A sound reader."""
    try:
        value = float((root / "n.txt").read_text())
    except (OSError, ValueError) as error:
        raise ProjectError(f"{root / 'n.txt'}: {str(error)[:50]}") from None
    if not np.isfinite(value):
        raise ProjectError(f"{root / 'n.txt'}: {value}; expected a finite number")
    return {"number": value}


def test_a_sound_reader_passes(tmp_path):
    tried = bench(tmp_path, number)
    assert tried.judge(Mutation({"n.txt": b"1.50"})).outcome == SAME
    assert tried.judge(Mutation({"n.txt": b"2.5"})).outcome == OTHER
    for change in (b"nan", b"x", Special("absent"), Special("folder"), Special("loop")):
        assert tried.judge(Mutation({"n.txt": change})).outcome == REFUSED
    assert tried.judge(Mutation({})).outcome == SAME  # every change was undone


@pytest.mark.parametrize(
    ("read", "why"),
    [
        (lambda root: {"n": float((root / "n.txt").read_text())}, "ValueError"),
        (lambda root: {"n": 1, "kept": mapped(40 << 20)}, "took "),
        (lambda root: {"n": (root / "../outside/secret.png").read_bytes()}, "read /"),
        (lambda root: {"n": np.array([np.inf])}, "unsound"),
        (lambda root: {"n": time.monotonic_ns()}, "read twice"),
        (lambda root: refuse("a\x1b[31m"), None),
        (lambda root: refuse(""), "without words"),
    ],
)
def test_an_unsound_reader_is_found_out(tmp_path, monkeypatch, read, why):
    monkeypatch.setattr(judge, "TWICE", 1)
    monkeypatch.setattr(judge, "SPARE_BYTES", 16 << 20)

    def only_when_changed(root: Path) -> Any:
        text = (root / "n.txt").read_text()
        return {"n": 1.5} if text == "1.5\n" else read(root)

    verdict = bench(tmp_path, only_when_changed).judge(Mutation({"n.txt": b"x"}))
    if why is None:
        assert verdict.outcome == REFUSED
        return
    assert verdict.outcome == FAILED
    assert why in verdict.why


def mapped(count: int) -> Any:
    """So many bytes that no freed memory of the process serves for."""
    array = np.frombuffer(mmap.mmap(-1, count), np.uint8)
    array[:] = 1
    return array


def refuse(words: str) -> Any:
    """Raise an error of these words."""
    raise ProjectError(words)
