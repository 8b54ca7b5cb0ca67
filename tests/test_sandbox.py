from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from gvtools.errors import MemoryFileError
from gvtools.sandbox import Item, ReaderError, read_apart


def reader(path: Path, *, how: str) -> Iterator[Item]:
    yield {}, {}
    for number in range(2):
        yield {"number": number}, {"values": np.arange(number + 1)}
    if how == "memory":
        np.ones(1 << 28)
    elif how == "crash":
        os.abort()
    elif how == "word":
        raise MemoryFileError(f"{path}: no such points")


@pytest.fixture
def path(tmp_path: Path) -> Path:
    (tmp_path / "a.bin").write_bytes(b"123")
    return tmp_path / "a.bin"


def test_items_pass_in_their_order(path):
    items = list(read_apart(f"{__name__}:reader", path, how="whole"))
    assert [facts["number"] for facts, _ in items] == [0, 1]
    assert [arrays["values"].tolist() for _, arrays in items] == [[0], [0, 1]]


@pytest.mark.parametrize(
    ("how", "error", "said"),
    [("memory", ReaderError, "status"), ("crash", ReaderError, "status"),
     ("word", MemoryFileError, "no such points")],
)  # fmt: skip
def test_limits_crashes_and_errors_end_in_one_error(path, how, error, said):
    items = read_apart(f"{__name__}:reader", path, how=how)
    assert [next(items)[0]["number"] for _ in range(2)] == [0, 1]
    with pytest.raises(error, match=said):
        next(items)
