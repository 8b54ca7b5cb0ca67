"""``gvtools check`` and ``data``: projects and data sets as they were downloaded, and shards."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from gvtools.errors import GvError, ProjectError
from pipelines.commands.arguments import SceneArguments
from pipelines.options import Arguments

if TYPE_CHECKING:
    from gvtools.scenes.inspection import SceneReport
    from pipelines.console import Console


LEVELS = ("error", "warning", "info")


class CheckCommand(SceneArguments):
    """Tell what a run would read of a project, and what is wrong with it."""

    examples = (
        "gvtools check my_colmap_workspace",
        "gvtools check scans/kitchen --json check.json",
    )
    positional = ("project",)

    project: Path
    """A folder, a transforms.json or spec:NAME:SCENE. [PROJECT]"""
    json_: Path | None = None
    """Write the report there. [FILE]"""

    def run(self, console: Console) -> None:
        from gvtools.files import write_json
        from gvtools.scenes.inspection import inspect

        try:
            result = inspect(self.open_scene(self.project))
        except GvError as error:
            if self.json_ is not None:
                finding = {"level": "error", "message": str(error)}
                write_json(
                    self.json_, {"root": str(self.project), "ok": False, "findings": [finding]}
                )
            raise
        if self.json_ is not None:
            write_json(self.json_, result.to_dict())
            console.line(f"report written to {self.json_}")
        else:
            _print(result, console)
        errors = [finding.message for finding in result.findings if finding.level == "error"]
        if not result.ok:
            raise ProjectError(
                f"{self.project}: not ok: {len(errors)} errors, first: {errors[0]}; mend it "
                "and check again"
            )


def _print(result: SceneReport, console: Console) -> None:
    unit = "m" if result.metric else "scene units"
    rows: list[tuple[str, Any]] = [
        ("project", result.root),
        ("kind", result.kind),
        ("views", result.views),
        ("views opened", result.views_opened),
        ("sizes", ", ".join(f"{size} ({n} views)" for size, n in result.sizes.items())),
        ("focal length, pixels", _span(*result.focal_px)),
        ("path length", f"{result.path_length:.4g} {unit}"),
        ("extent of the centres", f"{result.extent:.4g} {unit}"),
        ("masked pixels", f"{result.masked:.1%}"),
    ]
    if result.sparse_points:
        rows.append(("sparse points", f"{result.sparse_points} ({result.observations} seen)"))
    if result.reprojection_px is not None:
        rows.append(("reprojection error, pixels", f"{result.reprojection_px:.3f}"))
    depth = result.depth
    if depth is None:
        rows.append(("depth", "none"))
    else:
        rows.append(("views with depth", depth.views))
        if depth.coverage is not None:
            rows.append(("pixels with depth", f"{depth.coverage:.1%}"))
        if depth.median is not None:
            low, middle, high = depth.minimum, depth.median, depth.maximum
            rows.append(("depth, median", f"{middle:.4g} ({low:.4g} to {high:.4g}) {unit}"))
    width = max(len(label) for label, _ in rows)
    for label, value in rows:
        console.line(f"{label.ljust(width)}  {value}")
    for level in LEVELS:
        for finding in result.findings:
            if finding.level == level:
                console.line(f"{level}: {finding.message}")
    console.line(f"ok: {'true' if result.ok else 'false'}")


def _span(low: float, high: float) -> str:
    return f"{low:.1f}" if high - low < 0.05 else f"{low:.1f} to {high:.1f}"


class ListData(Arguments):
    """Data sets there is a spec of, or all that is known of one."""

    examples = ("", "hypersim", "--json data_sets.json")

    positional = ("name",)

    name: str | None = None
    """Print all that is known of this one. [NAME]"""
    json_: Path | None = None
    """Write what is known there, with its weight. [FILE]"""

    def run(self, console: Console) -> None:
        from pipelines.data_sets.downloads import list_data_sets

        list_data_sets(self, console)


class DownloadArguments(Arguments):
    """The download of a data set."""

    positional = ("name", "root")

    name: str
    """Of the data set; gvtools data list has them. [NAME]"""
    root: Path
    """The folder of its download, or of a part. [ROOT]"""
    scene: tuple[str, ...] = ()
    """This one alone; may be repeated. [S]"""
    json_: Path | None = None
    """Write the figures there as well. [FILE]"""


class CheckDownload(DownloadArguments):
    """What of a download can be read, scene by scene; a few views of each are decoded."""

    examples = ("7-Scenes data/7scenes", "dl3dv data/dl3dv --scene 1K/0a1b --json check.json")

    def run(self, console: Console) -> None:
        from pipelines.data_sets.downloads import check_data_set

        check_data_set(self, console)


class CountDownload(DownloadArguments):
    """Views, baselines, focal lengths and depths of a download."""

    examples = ("7-Scenes data/7scenes", "7-Scenes data/7scenes --scene chess/seq-01")

    def run(self, console: Console) -> None:
        from pipelines.data_sets.downloads import statistics_of_data_set

        statistics_of_data_set(self, console)


class WriteShards(Arguments):
    """Write scenes as WebDataset shards; goes on where it was stopped."""

    examples = (
        "7-Scenes --root data/7scenes --out shards/7scenes --max-side 320",
        "scan/ --out shards/scan",
    )

    positional = ("scenes_of",)

    scenes_of: str
    """A data set's name with --root, spec:NAME:SCENE with --root, or a project's folder.
    [NAME|PROJECT]"""
    root: Path | None = None
    """The folder of the data set's download. [DIR]"""
    out: Path
    """The folder of the shards. [DIR]"""
    scenes: tuple[str, ...] = ()
    """Of the data set, by name (all). [SCENE ...]"""
    size: float = 256
    """Of a shard. [MB]"""
    max_side: int | None = None
    """Reduce pictures to this length of their longer side (as they are). [px]"""

    def run(self, console: Console) -> None:
        from pipelines.data_sets.shards import shards

        shards(self, console)


class VerifyShards(Arguments):
    """Compare shards with their checksums."""

    examples = ("shards/7scenes",)

    positional = ("folder",)

    folder: Path
    """A folder of shards. [DIR]"""

    def run(self, console: Console) -> None:
        from pipelines.data_sets.shards import verify

        verify(self, console)


class DataCommand(Arguments):
    """List public data sets, check and sum up a download, make shards of it for training."""

    examples = (
        "gvtools data list",
        "gvtools data check 7-Scenes data/7scenes",
        "gvtools data shards 7-Scenes --root data/7scenes --out shards/7scenes --max-side 320",
    )
    actions: ClassVar = {
        "list": ListData, "check": CheckDownload, "stats": CountDownload, "shards": WriteShards,
        "verify": VerifyShards,
    }  # fmt: skip
