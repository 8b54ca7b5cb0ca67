from __future__ import annotations

import threading

import pytest

from gvtools.prefetch import prefetch


def test_items_come_in_order_with_the_next_one_begun():
    begun: list[int] = []
    second = threading.Event()

    def load(item: int) -> int:
        begun.append(item)
        if item == 1:
            second.set()
        return 10 * item

    items = prefetch(load, range(4))
    assert next(items) == 0
    # Nobody has asked for it yet.
    assert second.wait(5) and 3 not in begun
    assert list(items) == [10, 20, 30]
    assert list(prefetch(load, [])) == []


def test_an_error_comes_where_its_item_would_have():
    def load(item: int) -> int:
        if item == 1:
            raise ValueError("broken")
        return item

    items = prefetch(load, range(3))
    assert next(items) == 0
    with pytest.raises(ValueError, match="broken"):
        next(items)
