"""``gvtools data check``: what of a download can be read, one scene at a time."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gvtools.errors import GvError, OptionError, ProjectError
from gvtools.files import json_list_written
from gvtools.scenes.data_sets.catalogue import DataSetSpec, chosen_scenes, load_spec, read_scene

if TYPE_CHECKING:
    from gvtools.scenes.inspection import SceneReport
    from pipelines.console import Console

# Views of a scene whose pixels are decoded, evenly spread.
PROBES = 8
# Levels of findings, and what one line calls them.
NOUNS = {"error": "errors", "warning": "warnings", "info": "notes"}


@dataclass(frozen=True)
class SceneCheck:
    """A scene of a download.

    Attributes:
        scene: its name.
        report: None where nothing of it could be read.
        problem: the first thing that keeps it from being used; None where it can be.
    """

    scene: str
    report: SceneReport | None
    problem: str | None = None

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready values."""
        if self.report is None:
            return {"scene": self.scene, "ok": False, "problem": self.problem}
        return {"scene": self.scene, **self.report.to_dict(), "problem": self.problem}


def check_data_set(args: argparse.Namespace, console: Console) -> None:
    """Report on each scene as soon as it is read."""
    spec = load_spec(args.name)
    names = chosen_scenes(args.name, args.root, args.scene)
    counted: Counter[str] = Counter()
    said: set[tuple[str, str]] = set()
    bad: list[str] = []
    with ExitStack() as stack:
        written = None
        if args.json is not None:
            head = {"data_set": spec.name, "root": str(args.root)}
            written = stack.enter_context(json_list_written(args.json, head, "scenes"))
        for check in checks(spec, args.root, names):
            _print(check, console, said)
            if written is not None:
                written.add(check.to_dict())
            if check.report is not None:
                counted["views"] += check.report.views
                counted["depth"] += check.report.depth.views if check.report.depth else 0
            if check.problem is not None:
                counted["bad"] += 1
                bad = bad or [f"{check.scene}: {check.problem}"]
    console.line(
        f"{args.root}: {len(names):,} scenes, {counted['views']:,} views, {counted['depth']:,} "
        f"with depth (all of {spec.name}: {_whole(spec)})"
    )
    if bad:
        raise ProjectError(
            f"{args.root}: {counted['bad']} of {len(names)} scenes cannot be used, first {bad[0]}"
        )


def checks(spec: DataSetSpec, root: Path, scenes: Iterable[str]) -> Iterator[SceneCheck]:
    """Read scenes one after the other; none is kept."""
    from gvtools.scenes.inspection import inspect

    for scene in scenes:
        try:
            report = inspect(read_scene(spec, scene, root), probes=PROBES)
        except OptionError:
            raise
        except GvError as error:
            yield SceneCheck(scene, None, str(error))
        else:
            errors = (item.message for item in report.findings if item.level == "error")
            yield SceneCheck(scene, report, next(errors, None))


def _print(check: SceneCheck, console: Console, said: set[tuple[str, str]]) -> None:
    """A line for the scene, and one for each finding that no scene before had."""
    report = check.report
    if report is None:
        console.line(f"{check.scene}: cannot be read")
        console.line(f"  error: {check.problem}")
        return
    sizes = ", ".join(report.sizes)
    line = [f"{check.scene}: {report.views:,} views of {sizes}"]
    depth = report.depth
    if depth is not None:
        line.append(f"{depth.views:,} with depth")
    if depth is not None and depth.median is not None:
        unit = "m" if report.metric else "scene units"
        low, middle, high = depth.minimum, depth.median, depth.maximum
        line.append(f"{low:.4g} to {high:.4g} {unit}, median {middle:.4g}")
    levels = Counter(item.level for item in report.findings)
    line += [f"{levels[level]} {NOUNS[level]}" for level in NOUNS if levels[level]]
    console.line("; ".join(line))
    for level in NOUNS:
        for item in report.findings:
            if item.level == level and (level, item.message) not in said:
                said.add((level, item.message))
                console.line(f"  {level}: {item.message}")


def _whole(spec: DataSetSpec) -> str:
    counts = (spec.counts.scenes, "scenes"), (spec.counts.images, "images")
    known = [f"{number:,} {of}" for number, of in counts if number is not None]
    return ", ".join(known) or "counts not known"
