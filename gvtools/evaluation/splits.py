"""Splits of a scene's views into context and targets, by the rule of a benchmark.

The protocol's rule: a round has two context views and six target views; long sequences have three
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
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from gvtools.errors import OptionError, ProjectError
from gvtools.specs import SpecRecord
from gvtools.untrusted import read_json

Numbers = Annotated[tuple[int, ...], Field(strict=False)]


class SplitRule(SpecRecord):
    """A rule, and where it is cited from."""

    # "every": each K-th view is a target, the context is spread evenly over the others. "listed":
    # numbers of views, the first ones of the context. "files": a file beside the scene's pictures.
    # "protocol": ``gvtools.evaluation.splits``.
    kind: Literal["every", "listed", "files", "protocol"]
    views: Numbers = ()  # the numbers of context views that it serves; empty for all
    every: int | None = Field(None, ge=2)  # K of "every"
    # Of "listed", numbers from 0 on in the scene's order; the first N are given.
    context: Numbers = ()
    targets: Numbers = ()  # of "listed"
    # Of "files", in the scene's folder; {views} stands for the number of context views. It holds
    # ``train_ids`` and ``test_ids``, numbers of the frames of ``transforms.json``.
    file: str = ""
    # Folder of the data set's own reduced pictures, which are read where they are there.
    copies: str = ""
    # What the width and height of the recorded pictures are divided by; None leaves them, or takes
    # the benchmark's resolution.
    divided_by: int | None = Field(None, ge=1)
    # Of "protocol", views from one of the window to the next; None takes the widest.
    stride: int | None = Field(None, ge=1)
    source: str  # where the rule is from

    @model_validator(mode="after")
    def _complete(self) -> SplitRule:
        needed = {"every": (self.every,), "listed": (self.context, self.targets),
                  "files": (self.file,), "protocol": ()}  # fmt: skip
        if not all(needed[self.kind]):
            raise ValueError(f"a split of kind {self.kind} lacks what tells its views")
        return self


@dataclass(frozen=True)
class SceneSplit:
    """Views of one scene that are given, and those that are completed."""

    context: tuple[str, ...]  # names of the given views, in the scene's order
    # Names of the targets, round by round; one round where their number is open.
    rounds: tuple[tuple[str, ...], ...]
    # Of the protocol's: layout ("ends" or "first"), stride and start of the window in the scene's
    # views, how many views the scene has, and the seed that the start was drawn from.
    window: Mapping[str, Any] = field(default_factory=dict)

    @property
    def targets(self) -> tuple[str, ...]:
        """The targets of all rounds, in order."""
        return tuple(name for names in self.rounds for name in names)

    def to_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        rounds = [list(names) for names in self.rounds]
        return {"context": list(self.context), "rounds": rounds, **self.window}


def split_scene(
    rule: SplitRule,
    names: Sequence[str],
    *,
    views: int,
    targets: int | None = None,
    rounds: int = 1,
    folder: Path | None = None,
) -> SceneSplit:
    """The views of a scene that a rule gives and completes.

    The scene's folder is read for "files"; targets of a round and rounds are of "protocol".

    >>> rule = SplitRule(kind="every", every=8, source="RegNeRF")
    >>> split = split_scene(rule, [f"{i:02d}" for i in range(20)], views=3)
    >>> split.context, split.targets
    (('01', '10', '19'), ('00', '08', '16'))
    """
    if rule.kind == "protocol":
        return protocol_split(
            names, context=views, targets=targets or 6, rounds=rounds, stride=rule.stride
        )
    if rule.kind == "every":
        step = rule.every or 8
        others = [i for i in range(len(names)) if i % step]
        if views > len(others):
            raise OptionError(
                f"{len(names)} views, of which {len(others)} are no targets; expected at least "
                f"{views}; give fewer --views"
            )
        # Halves are rounded to even numbers, as in the code that the split is cited from.
        rows = [round(place) for place in np.linspace(0, len(others) - 1, views).tolist()]
        given, held = [others[row] for row in rows], list(range(0, len(names), step))
    elif rule.kind == "listed":
        given, held = sorted(rule.context[:views]), list(rule.targets)
    else:
        return _from_file(rule, names, views=views, folder=folder)
    if max([*given, *held]) >= len(names) or len(given) < views:
        raise OptionError(
            f"{len(names)} views; expected at least {max([*given, *held]) + 1}, of which {views} "
            "are given; the scene may be incomplete"
        )
    return SceneSplit(tuple(names[i] for i in given), (tuple(names[i] for i in held),))


def _from_file(
    rule: SplitRule, names: Sequence[str], *, views: int, folder: Path | None
) -> SceneSplit:
    if folder is None:
        raise ProjectError(f"{rule.file}: no folder to look for it in")
    path = folder / rule.file.format(views=views)
    by_name = {PurePosixPath(name).name: name for name in names}
    try:
        split, frames = _json(path), _json(folder / "transforms.json").get("frames")
        files = [PurePosixPath(frame["file_path"]).name for frame in frames]
        given, held = (
            tuple(by_name[files[i]] for i in split[key]) for key in ("train_ids", "test_ids")
        )
    except (AttributeError, KeyError, IndexError, TypeError) as error:
        raise ProjectError(
            f"{path}: train_ids and test_ids do not fit the views ({error}); expected numbers of "
            "the frames of transforms.json, whose pictures are there"
        ) from None
    return SceneSplit(given, (held,))


def _json(path: Path) -> Any:
    try:
        return read_json(path)
    except (OSError, ValueError) as error:
        raise ProjectError(f"{path}: unreadable ({error}); expected the released file") from None


def protocol_split(
    names: Sequence[str],
    *,
    context: int = 2,
    targets: int = 6,
    rounds: int = 1,
    stride: int | None = None,
    seed: int = 0,
) -> SceneSplit:
    """The split of a scene by the protocol's rule; the targets are those of a round.

    Without a stride, it is as wide as the scene allows. In a video's many frames that leaves the
    views little in common; give a number there. The same seed takes about the same part of any
    scene.
    """
    if stride is not None and stride < 1:
        raise OptionError(f"stride {stride}; expected at least 1")
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
    return SceneSplit(
        context=tuple(chosen[i] for i in given),
        rounds=tuple(tuple(left[r * targets : (r + 1) * targets]) for r in range(rounds)),
        window={
            "layout": layout,
            "stride": stride,
            "start": start,
            "views": len(names),
            "seed": seed,
        },
    )
