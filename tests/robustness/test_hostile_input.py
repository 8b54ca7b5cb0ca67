"""What readers make of damaged and hostile files: exact data or one named error, and no more.

Inputs that once failed are kept in ``tests/corpus`` and judged again here; the whole table, 10,000
mutations of each reader, is ``python -m hostile`` (docs/robustness.md).
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hostile import judge
from hostile.__main__ import ONE_THREAD
from hostile.corpus import CORPUS, entries
from hostile.judge import FAILED, OTHER, REFUSED, SAME, Bench
from hostile.mutations import Special, mutated
from hostile.readers import READERS, Reader, data_sets
from hostile.worker import figures, slug

from gvtools.errors import ProjectError

ROOT = Path(__file__).parents[2]


def python(*words: str, **more: Any) -> subprocess.CompletedProcess[str]:
    """Python with the product and the fixtures on its path, libraries on one thread."""
    threads = dict.fromkeys(("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    path = f"{ROOT}{os.pathsep}{ROOT / 'tests' / 'fixtures'}"
    return subprocess.run(
        [sys.executable, *words], env={**os.environ, **ONE_THREAD, **threads, "PYTHONPATH": path},
        capture_output=True, text=True, cwd=ROOT, **more,
    )  # fmt: skip


def replayed(names: list[str]) -> None:
    """The corpus of readers, and a few mutations of each, in a process of their own.

    A reader that crashes would take the tests with it.
    """
    done = python("-m", "hostile.corpus", *names)
    assert done.returncode == 0, done.stderr[-3000:]
    judged = int(done.stdout.split()[-2])
    assert judged >= sum(len(entries(name)) for name in names) + len(names)


def test_what_once_failed_is_read_or_refused():
    # Those that read dear samples, weights and USD, are judged by the table and tests of their own.
    replayed([reader.name for reader in READERS if reader.share >= 0.1])


@pytest.mark.slow
def test_layouts_and_dear_samples_that_once_failed_are_read_or_refused():
    dear = [reader for reader in READERS if reader.share < 0.1]
    replayed([reader.name for reader in (*dear, *data_sets()) if entries(reader.name)])


def test_the_corpus_belongs_to_readers_and_is_small():
    known = {slug(reader.name) for reader in (*READERS, *data_sets())}
    files = list(CORPUS.glob("*"))
    assert {file.stem for file in files} <= known
    assert sum(file.stat().st_size for file in files) < 500_000


@pytest.mark.slow
def test_thousands_of_mutations_of_every_reader(tmp_path):
    out = Path(os.environ.get("GVTOOLS_HOSTILE_OUT", tmp_path))
    count = os.environ.get("GVTOOLS_HOSTILE_COUNT", "10000")
    done = python("-m", "hostile", "--count", count, "--out", str(out))
    print(done.stdout)
    assert done.returncode == 0, done.stdout[-6000:] + done.stderr[-2000:]
    assert all(figures(out, reader.name)["next"] > 0 for reader in (*READERS, *data_sets()))


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
    judge_finite = np.isfinite(value)
    if not judge_finite:
        raise ProjectError(f"{root / 'n.txt'}: {value}; expected a finite number")
    return {"number": value}


def test_a_sound_reader_passes(tmp_path):
    tried = bench(tmp_path, number)
    assert tried.judge({"n.txt": b"1.50"}).outcome == SAME
    assert tried.judge({"n.txt": b"2.5"}).outcome == OTHER
    for change in (b"nan", b"x", Special("absent"), Special("folder"), Special("loop")):
        assert tried.judge({"n.txt": change}).outcome == REFUSED
    assert tried.judge({}).outcome == SAME  # every change was undone


@pytest.mark.parametrize(
    ("read", "why"),
    [
        (lambda root: {"n": float((root / "n.txt").read_text())}, "ValueError"),
        (lambda root: {"n": np.zeros(400 << 20, np.uint8) + 1}, "took "),
        (lambda root: {"n": (root / "../outside/secret.png").read_bytes()}, "read /"),
        (lambda root: {"n": judge_sound(np.array([np.inf]))}, "unsound"),
        (lambda root: {"n": time.monotonic_ns()}, "read twice"),
        (lambda root: refuse("a\x1b[31m"), None),
        (lambda root: refuse(""), "without words"),
    ],
)
def test_an_unsound_reader_is_found_out(tmp_path, monkeypatch, read, why):
    monkeypatch.setattr(judge, "TWICE", 1)

    def only_when_changed(root: Path) -> Any:
        text = (root / "n.txt").read_text()
        return {"n": 1.5} if text == "1.5\n" else read(root)

    verdict = bench(tmp_path, only_when_changed).judge({"n.txt": b"x"})
    if why is None:
        assert verdict.outcome == REFUSED
        return
    assert verdict.outcome == FAILED
    assert why in verdict.why


def judge_sound(values: np.ndarray) -> np.ndarray:
    """As readers of the table check what they got."""
    from hostile.soundness import finite

    return finite(values, "n")


def refuse(words: str) -> Any:
    """Raise an error of these words."""
    raise ProjectError(words)


def test_mutations_are_those_of_their_seed():
    files = {
        "a.json": b'{"a": [1, 2.5], "b": "c.png"}',
        "b.bin": bytes(range(256)),
        "c.txt": b"1 2",
    }
    rounds = [
        [mutated(files, np.random.default_rng(seed), outside="/o") for seed in range(300)]
        for _ in range(2)
    ]
    assert rounds[0] == rounds[1]
    changed = [dict(m.changes) for m in rounds[0]]
    assert len({str(change) for change in changed}) > 200
    assert sum(any(files[n] != c for n, c in change.items()) for change in changed) > 280
