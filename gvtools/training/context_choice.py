"""Which views of a path are given, and how many: by rules as users choose their context."""

from __future__ import annotations

import numpy as np
from pydantic import Field, model_validator

from gvtools.errors import OptionError
from gvtools.settings import Settings

RULES = ("every", "ends", "first")
COUNTS = 101  # the stream of random numbers that counts are drawn from


class ContextOptions(Settings):
    """How many views are given, and which."""

    section = "context"

    least: int = Field(1, ge=1)
    """Context views."""
    most: int = 4
    """Context views, at least ``least``."""
    group: int = Field(8, ge=1)
    """So many samples in a row have the same number, so that a batch of them is possible."""
    extrapolation: float = Field(0.5, ge=0, le=1)
    """Chance that the first views are given, and not views all along the path."""
    ends: float = Field(0.4, ge=0, le=1)
    """Chance, of the other cases, that both ends are given and not every k-th view."""

    @model_validator(mode="after")
    def _check(self) -> ContextOptions:
        if self.most < self.least:
            raise OptionError(f"context.most {self.most}; expected at least {self.least}")
        return self

    def count(self, seed: list[int], index: int) -> int:
        """The number of context views of a sample; ``seed`` is the data set's."""
        rng = np.random.default_rng([*seed, index // self.group, COUNTS])
        return int(rng.integers(self.least, self.most + 1))

    def chosen(self, rng: np.random.Generator, views: int, count: int) -> tuple[int, ...]:
        """Which of a path's views are given, ascending."""
        rule = "first"
        if rng.random() >= self.extrapolation:
            rule = "ends" if rng.random() < self.ends else "every"
        return chosen_context(rng, views, count, rule)


def chosen_context(rng: np.random.Generator, views: int, count: int, rule: str) -> tuple[int, ...]:
    """Which views of a path are given, ascending.

    Args:
        rng: places the views of "every".
        views: of the path.
        count: of context views.
        rule: "every" k-th view; evenly spaced with both "ends"; or the "first" ones.

    Raises:
        OptionError: no such rule, or no view is left as a target.
    """
    if not 1 <= count < views:
        raise OptionError(f"{count} context views of {views}; expected 1 to {views - 1}")
    if rule == "first":
        return tuple(range(count))
    if rule == "ends":
        last = views - 1
        return tuple(round(i * last / max(count - 1, 1)) for i in range(count))
    if rule != "every":
        raise OptionError(f"context rule {rule!r}; expected one of {', '.join(RULES)}")
    step = views // count
    start = int(rng.integers(0, views - step * (count - 1)))
    return tuple(start + step * i for i in range(count))
