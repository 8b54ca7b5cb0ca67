"""``gvtools data list``, ``check`` and ``stats``: data sets, and what of a download can be read."""

from __future__ import annotations

from collections import Counter
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from gvtools.errors import GvError, OptionError, ProjectError
from gvtools.files import json_list_written
from gvtools.scenes.data_sets import catalogue
from gvtools.scenes.inspection import SceneReport, inspect, spread, turn_degrees

if TYPE_CHECKING:
    from gvtools.scenes.scene import Scene
    from pipelines.commands.data import DownloadArguments, ListData
    from pipelines.console import Console

COLUMNS = ("data set", "kind", "scenes", "images", "weight", "roles", "layout")
# Views of a scene whose pixels are decoded, evenly spread.
PROBES = 8
# Levels of findings, and what one line calls them.
NOUNS = {"error": "errors", "warning": "warnings", "info": "notes"}
PERCENTILES = (5, 25, 50, 75, 95)


# --- list -------------------------------------------------------------------------------------


def list_data_sets(args: ListData, console: Console) -> None:
    """Print a table of the data sets, or everything about one."""
    names = catalogue.spec_names() if args.name is None else (args.name,)
    specs = [catalogue.load_spec(name) for name in names]
    known = [
        {**spec.model_dump(mode="json"), "weight": spec.weight, "share": shares().get(spec.name)}
        for spec in specs
    ]
    if args.write_json({"data_sets": known}):
        console.line(f"{len(specs)} data sets written to {args.json_}")
    elif args.name is None:
        console.table(COLUMNS, table_rows())
        console.line("weight: share in a mixture of all training sets, by the root of their images")
    else:
        console.line(as_yaml(specs[0]).rstrip())
        if specs[0].name in shares():
            console.line(f"# {shares()[specs[0].name]:.1%} of a mixture of all training sets")


def all_specs() -> list[catalogue.DataSetSpec]:
    """Training sets first, then by name."""
    specs = [catalogue.load_spec(name) for name in catalogue.spec_names()]
    return sorted(specs, key=lambda spec: ("training" not in spec.roles, spec.name.casefold()))


@cache
def shares() -> dict[str, float]:
    """Weights of the training sets in a mixture of all of them, of 1, by name."""
    weights = {spec.name: spec.weight for spec in all_specs() if "training" in spec.roles}
    return {name: weight / sum(weights.values()) for name, weight in weights.items()}


def table_rows() -> list[tuple[str | None, ...]]:
    """A row a data set, as COLUMNS names them."""
    rows: list[tuple[str | None, ...]] = []
    for spec in all_specs():
        counts = spec.counts.scenes, spec.counts.images
        texts = [None if count is None else f"{count:,}" for count in counts]
        share = f"{shares()[spec.name]:.1%}" if spec.name in shares() else None
        rows.append((spec.name, spec.kind, *texts, share, ", ".join(spec.roles), spec.layout))
    return rows


def as_yaml(spec: catalogue.DataSetSpec) -> str:
    """What is known of a data set, in the words of its file."""
    import yaml

    known = spec.model_dump(mode="json", exclude_none=True)
    return str(yaml.safe_dump(known, sort_keys=False, allow_unicode=True, width=96))


# --- check ------------------------------------------------------------------------------------


def check_data_set(args: DownloadArguments, console: Console) -> None:
    """Report on each scene as soon as it is read."""
    spec = catalogue.load_spec(args.name)
    names = catalogue.chosen_scenes(args.name, args.root, args.scene)
    counted: Counter[str] = Counter()
    said: set[tuple[str, str]] = set()
    bad: list[str] = []
    with ExitStack() as stack:
        written = None
        if args.json_ is not None:
            head = {"data_set": spec.name, "root": str(args.root)}
            written = stack.enter_context(json_list_written(args.json_, head, "scenes"))
        for scene in names:
            report, problem = _checked(spec, args.root, scene)
            if report is None:
                console.line(f"{scene}: cannot be read")
                console.line(f"  error: {problem}")
            else:
                _print_check(scene, report, console=console, said=said)
                counted["views"] += report.views
                counted["depth"] += report.depth.views if report.depth else 0
            if written is not None:
                found = {"ok": False} if report is None else report.to_dict()
                written.add({"scene": scene, **found, "problem": problem})
            if problem is not None:
                bad.append(f"{scene}: {problem}")
    published = (spec.counts.scenes, "scenes"), (spec.counts.images, "images")
    known = ", ".join(f"{number:,} {noun}" for number, noun in published if number is not None)
    console.line(
        f"{args.root}: {len(names):,} scenes, {counted['views']:,} views, {counted['depth']:,} "
        f"with depth (all of {spec.name}: {known or 'counts not known'})"
    )
    if bad:
        raise ProjectError(
            f"{args.root}: {len(bad)} of {len(names)} scenes cannot be used, first {bad[0]}"
        )


def _checked(
    spec: catalogue.DataSetSpec, root: Path, scene: str
) -> tuple[SceneReport | None, str | None]:
    """What of a scene can be read, if anything, and the first thing that keeps it from use."""
    try:
        report = inspect(catalogue.read_scene(spec, scene, root), probes=PROBES)
    except OptionError:
        raise
    except GvError as error:
        return None, str(error)
    errors = (item.message for item in report.findings if item.level == "error")
    return report, next(errors, None)


def _print_check(
    scene: str, report: SceneReport, *, console: Console, said: set[tuple[str, str]]
) -> None:
    """A line for the scene, and one for each finding that no scene before had."""
    line = [f"{scene}: {report.views:,} views of {', '.join(report.sizes)}"]
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


# --- stats ------------------------------------------------------------------------------------


# Bins from 10^LOW to 10^HIGH; neighbouring bins' middles differ by 1.16 %.
LOW, HIGH, PER_DECADE = -6, 8, 200


class LogHistogram:
    """Counts of values by their logarithm.

    A percentile is the middle of its bin: right to 0.6 % from 1e-6 to 1e8. The smallest and the
    largest value are kept as they are; a percentile below 1e-6 is given as the smallest.

    >>> values = LogHistogram()
    >>> values.add([1, 2, 3, 4, 1000])
    >>> round(values.percentile(50), 1), values.maximum
    (3.0, 1000.0)
    """

    def __init__(self) -> None:
        self.count = 0
        self.minimum = np.inf
        self.maximum = -np.inf
        self._bins = np.zeros((HIGH - LOW) * PER_DECADE, np.int64)

    def add(self, values: ArrayLike) -> None:
        """Count values of any shape that are 0 or more."""
        flat = np.asarray(values, np.float64).ravel()
        if not flat.size:
            return
        self.count += flat.size
        self.minimum = min(self.minimum, float(flat.min()))
        self.maximum = max(self.maximum, float(flat.max()))
        logs = np.log10(np.maximum(flat, 10.0**LOW))
        rows = np.clip(((logs - LOW) * PER_DECADE).astype(np.int64), 0, len(self._bins) - 1)
        self._bins += np.bincount(rows, minlength=len(self._bins))

    def percentile(self, percent: float) -> float:
        """The value below which so many of a hundred lie; NaN where there is none."""
        if not self.count:
            return float("nan")
        # The nearest rank, as numpy's method "inverted_cdf" takes it.
        rank = max(1, int(np.ceil(percent / 100 * self.count)))
        row = int(np.searchsorted(np.cumsum(self._bins), rank))
        if row == 0:
            return self.minimum
        middle = 10.0 ** (LOW + (row + 0.5) / PER_DECADE)
        return float(np.clip(middle, self.minimum, self.maximum))


# What is measured, by name.
MEASURED = {
    "views_per_scene": "views per scene",
    "baseline": "baseline to the next view, {unit}",
    "turn": "turn to the next view, degrees",
    "focal": "focal length, pixels",
    "field_of_view": "field of view, degrees",
    "depth": "depth, {unit}",  # of sampled views
    "coverage": "pixels with depth, %",
}


@dataclass
class DownloadStatistics:
    """Figures of scenes that were seen one after the other."""

    scenes: int = 0  # that were read
    skipped: int = 0  # that could not be
    views: int = 0
    with_depth: int = 0  # of the views
    sampled: int = 0  # views whose pixels were decoded
    unreadable: int = 0  # of the views that were to be
    metric: int = 0  # scenes whose units are metres
    sizes: Counter[str] = field(default_factory=Counter)  # "WIDTHxHEIGHT", numbers of views
    measured: dict[str, LogHistogram] = field(
        default_factory=lambda: {name: LogHistogram() for name in MEASURED}
    )

    @property
    def unit(self) -> str:
        """Of baselines and depth."""
        if self.metric == self.scenes:
            return "m"
        return "scene units" if not self.metric else "mixed units"

    def add(self, scene: Scene) -> None:
        """See a scene; a few of its views are decoded."""
        self.scenes += 1
        self.metric += scene.metric
        self.views += len(scene)
        self.measured["views_per_scene"].add(len(scene))
        self.with_depth += sum(view.has_depth for view in scene)
        if not scene.views:
            return
        cameras = scene.cameras
        self.sizes.update(f"{w}x{h}" for w, h in zip(cameras.width, cameras.height, strict=True))
        self.measured["focal"].add(cameras.K[:, (0, 1), (0, 1)].mean(axis=1))
        half = cameras.width / 2 / cameras.K[:, 0, 0]
        self.measured["field_of_view"].add(np.degrees(2 * np.arctan(half)))
        steps = np.diff(cameras.centers, axis=0)
        self.measured["baseline"].add(np.linalg.norm(steps, axis=1))
        self.measured["turn"].add(
            turn_degrees(cameras.cam_from_world[:-1], cameras.cam_from_world[1:])
        )
        for number in spread(len(scene), PROBES):
            self._decode(scene, number)

    def _decode(self, scene: Scene, number: int) -> None:
        try:
            frame = scene.views[number].load()
        except OptionError:
            raise
        except GvError:
            self.unreadable += 1
            return
        self.sampled += 1
        if frame.depth is not None:
            known = frame.depth[frame.depth > 0]
            self.measured["depth"].add(known)
            self.measured["coverage"].add(100 * known.size / frame.depth.size)

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready values."""
        counts = ("scenes", "skipped", "views", "with_depth", "sampled", "unreadable")
        spreads = {name: _spread(values) for name, values in self.measured.items()}
        sizes = {"unit": self.unit, "sizes": dict(self.sizes)}
        return {**{name: getattr(self, name) for name in counts}, **sizes, **spreads}


def statistics_of_data_set(args: DownloadArguments, console: Console) -> None:
    """Print figures of all scenes of a download together."""
    spec = catalogue.load_spec(args.name)
    names = catalogue.chosen_scenes(args.name, args.root, args.scene)
    total = DownloadStatistics()
    first = ""
    for name in console.track(names, "scenes"):
        try:
            total.add(catalogue.read_scene(spec, name, args.root))
        except OptionError:
            raise
        except GvError as error:
            total.skipped += 1
            first = first or f"{name}: {error}"
    if not total.scenes:
        raise ProjectError(f"{args.root}: none of {len(names)} scenes can be read, first {first}")
    if total.skipped:
        console.warn(f"{total.skipped} of {len(names)} scenes cannot be read, first {first}")
    if total.unreadable:
        console.warn(f"{total.unreadable} sampled views cannot be read; see gvtools data check")
    head = {"data_set": spec.name, "root": str(args.root)}
    if args.write_json({**head, **total.to_dict()}):
        console.line(f"figures written to {args.json_}")
    else:
        _print_statistics(total, console)


def _print_statistics(total: DownloadStatistics, console: Console) -> None:
    console.line(
        f"{total.scenes:,} scenes, {total.views:,} views, {total.with_depth:,} with depth; depth "
        f"of {total.sampled:,} sampled views"
    )
    sizes = ", ".join(f"{size} ({count:,})" for size, count in total.sizes.most_common(5))
    more = f" and {len(total.sizes) - 5} more sizes" if len(total.sizes) > 5 else ""
    console.line(f"pixels (views): {sizes}{more}")
    rows = []
    for name, values in total.measured.items():
        if values.count:
            numbers = [values.percentile(percent) for percent in PERCENTILES]
            label = MEASURED[name].format(unit=total.unit)
            rows.append((label, f"{values.count:,}", values.minimum, *numbers, values.maximum))
    columns = ("", "count", "min", *(f"{percent} %" for percent in PERCENTILES), "max")
    console.table(columns, rows)


def _spread(values: LogHistogram) -> dict[str, float] | None:
    if not values.count:
        return None
    percentiles = {f"p{percent}": values.percentile(percent) for percent in PERCENTILES}
    return {"count": values.count, "min": values.minimum, **percentiles, "max": values.maximum}
