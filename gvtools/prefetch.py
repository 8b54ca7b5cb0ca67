"""Reading ahead: the next file is decoded while the last one is worked on."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
Loaded = TypeVar("Loaded")


def prefetch(load: Callable[[Item], Loaded], items: Iterable[Item]) -> Iterator[Loaded]:
    """``load`` of each item, in order, the next one always begun in another thread.

    An error of ``load`` is raised where its item would have come.
    """
    with ThreadPoolExecutor(1) as pool:
        waiting = None
        for item in items:
            begun = pool.submit(load, item)
            if waiting is not None:
                yield waiting.result()
            waiting = begun
        if waiting is not None:
            yield waiting.result()
