"""``gvtools data stats``: sizes, baselines, focal lengths and depths of a download."""

from __future__ import annotations

import argparse
from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from gvtools.errors import GvError, OptionError, ProjectError
from gvtools.files import write_json
from gvtools.scenes.data_sets.catalogue import chosen_scenes, load_spec, read_scene
from gvtools.scenes.inspection import spread
from pipelines.data_sets.checking import PROBES
from pipelines.data_sets.log_histogram import LogHistogram

if TYPE_CHECKING:
    from gvtools.scenes.scene import Scene
    from pipelines.console import Console

PERCENTILES = (5, 25, 50, 75, 95)
COLUMNS = ("", "count", "min", *(f"{percent} %" for percent in PERCENTILES), "max")


@dataclass
class Statistics:
    """Figures of scenes that were seen one after the other.

    Attributes:
        scenes: how many were read.
        skipped: and how many could not be.
        views: of the scenes read.
        with_depth: of the views.
        sampled: views whose pixels were decoded.
        unreadable: of the views that were to be.
        metric: scenes whose units are metres.
        sizes: "WIDTHxHEIGHT" with the number of views; sizes beyond the commonest may be summed.
        views_per_scene: of the scenes read.
        baseline: from each view to the next, scene units.
        turn: from each view to the next, degrees.
        focal: of all views, pixels.
        field_of_view: across the width, degrees.
        depth: of the pixels of sampled views that have any, scene units.
        coverage: share of pixels with depth of each sampled view that has any, per cent.
    """

    scenes: int = 0
    skipped: int = 0
    views: int = 0
    with_depth: int = 0
    sampled: int = 0
    unreadable: int = 0
    metric: int = 0
    sizes: Counter[str] = field(default_factory=Counter)
    views_per_scene: LogHistogram = field(default_factory=LogHistogram)
    baseline: LogHistogram = field(default_factory=LogHistogram)
    turn: LogHistogram = field(default_factory=LogHistogram)
    focal: LogHistogram = field(default_factory=LogHistogram)
    field_of_view: LogHistogram = field(default_factory=LogHistogram)
    depth: LogHistogram = field(default_factory=LogHistogram)
    coverage: LogHistogram = field(default_factory=LogHistogram)

    @property
    def unit(self) -> str:
        """Of baselines and depth."""
        if self.metric == self.scenes:
            return "m"
        return "scene units" if not self.metric else "mixed units"

    def rows(self) -> list[tuple[str, LogHistogram]]:
        """The distributions with what they are of."""
        return [
            ("views per scene", self.views_per_scene),
            (f"baseline to the next view, {self.unit}", self.baseline),
            ("turn to the next view, degrees", self.turn),
            ("focal length, pixels", self.focal),
            ("field of view, degrees", self.field_of_view),
            (f"depth, {self.unit}", self.depth),
            ("pixels with depth, %", self.coverage),
        ]

    def add(self, scene: Scene) -> None:
        """See a scene; a few of its views are decoded."""
        self.scenes += 1
        self.metric += scene.metric
        self.views += len(scene)
        self.views_per_scene.add(len(scene))
        self.with_depth += sum(view.has_depth for view in scene)
        if not scene.views:
            return
        cameras = scene.cameras
        self.sizes.update(f"{w}x{h}" for w, h in zip(cameras.width, cameras.height, strict=True))
        self.focal.add(cameras.K[:, (0, 1), (0, 1)].mean(axis=1))
        half = cameras.width / 2 / cameras.K[:, 0, 0]
        self.field_of_view.add(np.degrees(2 * np.arctan(half)))
        self.baseline.add(np.linalg.norm(np.diff(cameras.centers, axis=0), axis=1))
        R = cameras.cam_from_world[:, :3, :3]
        # The Frobenius distance of two rotations that differ by the angle t is sqrt(8) sin(t / 2).
        sine = np.linalg.norm(R[1:] - R[:-1], axis=(1, 2)) / np.sqrt(8)
        self.turn.add(np.degrees(2 * np.arcsin(np.minimum(sine, 1))))
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
            self.depth.add(known)
            self.coverage.add(100 * known.size / frame.depth.size)

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready values."""
        counts = {
            name: getattr(self, name)
            for name in ("scenes", "skipped", "views", "with_depth", "sampled", "unreadable")
        }
        spreads = {
            name: _spread(getattr(self, name))
            for name in (
                "views_per_scene",
                "baseline",
                "turn",
                "focal",
                "field_of_view",
                "depth",
                "coverage",
            )
        }
        return {**counts, "unit": self.unit, "sizes": dict(self.sizes), **spreads}


def statistics_of_data_set(args: argparse.Namespace, console: Console) -> None:
    """Print figures of all scenes of a download together."""
    spec = load_spec(args.name)
    names = chosen_scenes(args.name, args.root, args.scene)
    total = Statistics()
    first = ""
    for name in console.track(names, "scenes"):
        try:
            total.add(read_scene(spec, name, args.root))
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
    if args.json is not None:
        head = {"data_set": spec.name, "root": str(args.root)}
        write_json(args.json, {**head, **total.to_dict()})
        console.line(f"figures written to {args.json}")
    else:
        _print(total, console)


def _print(total: Statistics, console: Console) -> None:
    console.line(
        f"{total.scenes:,} scenes, {total.views:,} views, {total.with_depth:,} with depth; depth "
        f"of {total.sampled:,} sampled views"
    )
    sizes = ", ".join(f"{size} ({count:,})" for size, count in total.sizes.most_common(5))
    more = f" and {len(total.sizes) - 5} more sizes" if len(total.sizes) > 5 else ""
    console.line(f"pixels (views): {sizes}{more}")
    rows = []
    for label, values in total.rows():
        if values.count:
            numbers = [values.percentile(percent) for percent in PERCENTILES]
            rows.append((label, f"{values.count:,}", values.minimum, *numbers, values.maximum))
    console.table(COLUMNS, rows)


def _spread(values: LogHistogram) -> dict[str, float] | None:
    if not values.count:
        return None
    percentiles = {f"p{percent}": values.percentile(percent) for percent in PERCENTILES}
    return {
        "count": values.count,
        "min": values.minimum,
        **percentiles,
        "max": values.maximum,
    }
