"""Which views of a path are given, and how many: by rules as users choose their context."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gvtools.errors import OptionError

COUNTS = 101  # the stream of random numbers that counts are drawn from
EXTRAPOLATION = 0.5  # chance that the first views are given, and not views all along the path
ENDS = 0.4  # chance, of the other cases, that both ends are given and not every k-th view


@dataclass(frozen=True)
class ContextChoice:
    """How many views are given, and which.

    Attributes:
        most: context views; at least one is given.
        group: so many samples in a row have the same number, so that a batch of them is possible.
    """

    most: int = 4
    group: int = 8

    def count(self, seed: list[int], index: int) -> int:
        """The number of context views of a sample; ``seed`` is the data set's."""
        rng = np.random.default_rng([*seed, index // self.group, COUNTS])
        return int(rng.integers(1, self.most + 1))

    def chosen(self, rng: np.random.Generator, views: int, count: int) -> tuple[int, ...]:
        """Which of a path's views are given, ascending."""
        rule = "first"
        if rng.random() >= EXTRAPOLATION:
            rule = "ends" if rng.random() < ENDS else "every"
        return chosen_context(rng, views, count, rule=rule)


def chosen_context(
    rng: np.random.Generator, views: int, count: int, *, rule: str
) -> tuple[int, ...]:
    """Which views of a path are given, ascending.

    Args:
        rng: places the views of "every".
        views: of the path.
        count: of context views.
        rule: "every" k-th view; evenly spaced with both "ends"; or the "first" ones.
    """
    if not 1 <= count < views:
        raise OptionError(f"{count} context views of {views}; expected 1 to {views - 1}")
    if rule == "first":
        return tuple(range(count))
    if rule == "ends":
        last = views - 1
        return tuple(round(i * last / max(count - 1, 1)) for i in range(count))
    step = views // count
    start = int(rng.integers(0, views - step * (count - 1)))
    return tuple(start + step * i for i in range(count))
