"""Which views of a scene are given and which are completed, round by round.

A round of the protocol has two context views and six target views; long sequences have three
rounds (``data_specs/benchmarks``). The source publishes neither its scenes' views nor how they were
chosen, so this is a rule of our own, and every split is written beside its scores:

1. A window of context + targets * rounds views, ``stride`` views apart, begins at a view drawn from
   ``seed`` among all that let it end inside the scene.
2. One round, to interpolate (layout "ends"): the context is spread evenly over the window, its
   first and last view included; the views between them are the targets. Several rounds, to
   extrapolate (layout "first"): the context comes first, the targets follow.
3. The targets, in the scene's order, are cut into rounds of equal size.
"""

from __future__ import annotations

import random
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from gvtools.errors import OptionError


@dataclass(frozen=True, kw_only=True)
class Split:
    """The views of one scene that are given, and those that are completed.

    Attributes:
        context: names of the given views, in the scene's order.
        rounds: per round the names of its targets, in the scene's order.
        layout: "ends" or "first".
        stride: views from one of the window to the next.
        start: index of the window's first view in the scene.
        views: how many views the scene has.
        seed: what ``start`` was drawn from.
    """

    context: tuple[str, ...]
    rounds: tuple[tuple[str, ...], ...]
    layout: str
    stride: int
    start: int
    views: int
    seed: int

    @property
    def targets(self) -> tuple[str, ...]:
        """The targets of all rounds, in order."""
        return tuple(name for names in self.rounds for name in names)

    def to_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return asdict(self) | {
            "context": list(self.context),
            "rounds": [list(names) for names in self.rounds],
        }


def protocol_split(
    names: Sequence[str],
    *,
    context: int = 2,
    targets: int = 6,
    rounds: int = 1,
    stride: int | None = None,
    seed: int = 0,
) -> Split:
    """The split of a scene by the rule above.

    Args:
        names: of the scene's views, in its order.
        context: how many views are given.
        targets: how many views a round completes.
        rounds: how many rounds.
        stride: views from one of the window to the next; None is as wide as the scene allows. In
            a video's many frames that leaves the views little in common; give a number there.
        seed: draws where the window begins. The same seed takes about the same part of any scene.
    """
    counts = {"context": context, "targets": targets, "rounds": rounds, "stride": stride}
    for what, number in counts.items():
        if number is not None and number < 1:
            raise OptionError(f"{what} {number}; expected at least 1")
    layout = "ends" if rounds == 1 else "first"
    window = context + targets * rounds
    if stride is None:
        stride = max((len(names) - 1) // (window - 1), 1)
    places = len(names) - (window - 1) * stride
    if places < 1:
        raise OptionError(
            f"{len(names)} views; expected at least {(window - 1) * stride + 1} for {context} "
            f"context and {rounds} x {targets} target views, {stride} apart; take a smaller "
            "stride, fewer rounds or fewer targets"
        )
    # Python promises this draw to be the same in every version, as NumPy does not.
    start = int(random.Random(seed).random() * places)
    chosen = [names[start + i * stride] for i in range(window)]
    if layout == "first" or context == 1:
        given = list(range(context))
    else:
        given = [i * (window - 1) // (context - 1) for i in range(context)]
    left = [name for i, name in enumerate(chosen) if i not in given]
    return Split(
        context=tuple(chosen[i] for i in given),
        rounds=tuple(tuple(left[r * targets : (r + 1) * targets]) for r in range(rounds)),
        layout=layout,
        stride=stride,
        start=start,
        views=len(names),
        seed=seed,
    )
