"""Which views of a scene are given and which are completed, by the rule of a benchmark."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from gvtools.errors import OptionError, ProjectError
from gvtools.evaluation.protocol import protocol_split
from gvtools.untrusted import read_json

Numbers = Annotated[tuple[int, ...], Field(strict=False)]


class SpecRecord(BaseModel):
    """Part of a specification: exactly these keys, of exactly these types."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


class SplitRule(SpecRecord):
    """A rule, and where it is cited from.

    Attributes:
        kind: "every": each K-th view is a target, the context is spread evenly over the others.
            "listed": numbers of views, the first ones of the context. "files": a file beside the
            scene's pictures. "protocol": ``gvtools.evaluation.protocol``.
        views: the numbers of context views that it serves; empty for all.
        every: K of "every".
        context: of "listed", numbers from 0 on in the scene's order; the first N are given.
        targets: of "listed".
        file: of "files", in the scene's folder; {views} stands for the number of context views. It
            holds ``train_ids`` and ``test_ids``, numbers of the frames of ``transforms.json``.
        copies: folder of the data set's own reduced pictures, which are read where they are there.
        divided_by: what the width and height of the recorded pictures are divided by; None leaves
            them, or takes the benchmark's resolution.
        stride: of "protocol", views from one of the window to the next; None takes the widest.
        source: where the rule is from.
    """

    kind: Literal["every", "listed", "files", "protocol"]
    views: Numbers = ()
    every: int | None = Field(None, ge=2)
    context: Numbers = ()
    targets: Numbers = ()
    file: str = ""
    copies: str = ""
    divided_by: int | None = Field(None, ge=1)
    stride: int | None = Field(None, ge=1)
    source: str

    @model_validator(mode="after")
    def _complete(self) -> SplitRule:
        needed = {"every": (self.every,), "listed": (self.context, self.targets),
                  "files": (self.file,), "protocol": ()}  # fmt: skip
        if not all(needed[self.kind]):
            raise ValueError(f"a split of kind {self.kind} lacks what tells its views")
        return self


@dataclass(frozen=True)
class SceneSplit:
    """Views of one scene.

    Attributes:
        context: names of those that are given, in the scene's order.
        rounds: names of the targets, round by round; one round where their number is open.
    """

    context: tuple[str, ...]
    rounds: tuple[tuple[str, ...], ...]

    @property
    def targets(self) -> tuple[str, ...]:
        """The targets of all rounds, in order."""
        return tuple(name for names in self.rounds for name in names)


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

    Args:
        rule: of the benchmark.
        names: of the scene's views, in its order.
        views: how many are given.
        targets: target views of a round, for "protocol".
        rounds: how many rounds, for "protocol".
        folder: of the scene, for "files".

    >>> rule = SplitRule(kind="every", every=8, source="RegNeRF")
    >>> split = split_scene(rule, [f"{i:02d}" for i in range(20)], views=3)
    >>> split.context, split.targets
    (('01', '10', '19'), ('00', '08', '16'))
    """
    if rule.kind == "protocol":
        chosen = protocol_split(
            names, context=views, targets=targets or 6, rounds=rounds, stride=rule.stride
        )
        return SceneSplit(chosen.context, chosen.rounds)
    if rule.kind == "every":
        given, held = _every(len(names), rule.every or 8, views)
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


def _every(count: int, step: int, views: int) -> tuple[list[int], list[int]]:
    """Numbers of the context and of the targets."""
    others = [i for i in range(count) if i % step]
    if views > len(others):
        raise OptionError(
            f"{count} views, of which {len(others)} are no targets; expected at least {views}; "
            "give fewer --views"
        )
    # Halves are rounded to even numbers, as in the code that the split is cited from.
    rows = [round(place) for place in np.linspace(0, len(others) - 1, views).tolist()]
    return [others[row] for row in rows], list(range(0, count, step))


def _from_file(
    rule: SplitRule, names: Sequence[str], *, views: int, folder: Path | None
) -> SceneSplit:
    if folder is None:
        raise ProjectError(f"{rule.file}: no folder to look for it in")
    path = folder / rule.file.format(views=views)
    split, frames = _json(path), _json(folder / "transforms.json").get("frames")
    by_name = {PurePosixPath(name).name: name for name in names}
    try:
        files = [PurePosixPath(frame["file_path"]).name for frame in frames]
        given, held = (
            tuple(by_name[files[i]] for i in split[key]) for key in ("train_ids", "test_ids")
        )
    except (KeyError, IndexError, TypeError) as error:
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
