"""``gvtools check`` and ``data``: projects and data sets as they were downloaded, and shards."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from gvtools.errors import GvError, OptionError, ProjectError
from gvtools.specs import name_key
from pipelines.commands.arguments import SceneArguments
from pipelines.options import Arguments, JsonArguments

if TYPE_CHECKING:
    from gvtools.scenes.inspection import SceneReport
    from gvtools.scenes.shard_writer import WrittenShard
    from pipelines.console import Console


LEVELS = ("error", "warning", "info")
# Of what could not be converted, so many are named; all are in index.json.
NAMED = 5


class CheckCommand(SceneArguments, JsonArguments):
    """Tell what a run would read of a project, and what is wrong with it."""

    examples = (
        "gvtools check my_colmap_workspace",
        "gvtools check scans/kitchen --json check.json",
    )
    positional = ("project",)

    project: Path
    """A folder, a .zip of it, a transforms.json or spec:NAME:SCENE. [PROJECT]"""

    def run(self, console: Console) -> None:
        from gvtools.scenes.inspection import inspect

        try:
            result = inspect(self.open_scene(self.project))
        except GvError as error:
            finding = {"level": "error", "message": str(error)}
            self.write_json({"root": str(self.project), "ok": False, "findings": [finding]})
            raise
        if self.write_json(result.to_dict()):
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
        ("views", f"{result.views} ({result.dropped} dropped)" if result.dropped else result.views),
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
    warnings = sum(finding.level == "warning" for finding in result.findings)
    counts = {"frames dropped": result.dropped, "warnings": warnings}
    said = "; ".join(f"{what}: {count}" for what, count in counts.items() if count)
    console.line(f"ok: {'true' if result.ok else 'false'}{said and f' ({said})'}")


def _span(low: float, high: float) -> str:
    return f"{low:.1f}" if high - low < 0.05 else f"{low:.1f} to {high:.1f}"


class ListData(JsonArguments):
    """Data sets there is a spec of, or all that is known of one."""

    examples = ("", "hypersim", "--json data_sets.json")

    positional = ("name",)

    name: str | None = None
    """Print all that is known of this one. [NAME]"""

    def run(self, console: Console) -> None:
        from pipelines.data_sets.downloads import list_data_sets

        list_data_sets(self, console)


class DownloadArguments(JsonArguments):
    """The download of a data set."""

    positional = ("name", "root")

    name: str
    """Of the data set; gvtools data list has them. [NAME]"""
    root: Path
    """The folder of its download, or of a part. [ROOT]"""
    scene: tuple[str, ...] = ()
    """This one alone; may be repeated. [S]"""


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
        from gvtools.scenes.data_sets.catalogue import spec_names
        from gvtools.scenes.layout import SPEC
        from gvtools.scenes.project import open_collection
        from gvtools.scenes.shard_writer import MEGABYTE, ShardOptions, write_shards

        address = self.scenes_of
        if self.root is not None and not address.startswith(SPEC):
            address = SPEC + address
        if self.root is None and not Path(address).exists() and name_key(address) in spec_names():
            raise OptionError(
                f"{address}: a data set; give the folder of its download by --root DIR"
            )
        collection = open_collection(address, self.root)
        if self.scenes:
            collection = collection.subset(self.scenes)

        def report(done: WrittenShard) -> None:
            shard = done.shard
            at = shard.views[-1].scene + 1
            console.line(
                f"{shard.file}: {len(shard.views)} views, {shard.bytes / MEGABYTE:.1f} MB, up to "
                f"scene {at} of {done.scenes}{' (complete before)' if done.before else ''}"
            )

        options = ShardOptions(self.size, self.max_side)
        index = write_shards(collection, self.out, options=options, progress=report)
        views = sum(scene.views for scene in index.scenes)
        depth = sum(scene.with_depth for scene in index.scenes)
        for item in index.skipped[:NAMED]:
            console.warn(f"left out: {item.reason}")
        if len(index.skipped) > NAMED:
            console.warn(f"left out: {len(index.skipped) - NAMED} more, listed in index.json")
        console.line(
            f"{self.out}: {len(index.shards)} shards of {len(index.scenes)} scenes, {views} views, "
            f"{depth} with depth; train from them with data.scenes"
        )


class VerifyShards(Arguments):
    """Compare shards with their checksums."""

    examples = ("shards/7scenes",)

    positional = ("folder",)

    folder: Path
    """A folder of shards. [DIR]"""

    def run(self, console: Console) -> None:
        from gvtools.scenes.shards import read_index
        from gvtools.scenes.shards import verify as problems_of

        problems = problems_of(self.folder)
        count = len(read_index(self.folder).shards)
        if len(problems) > 1:
            for problem in problems:
                console.warn(problem)
        if problems:
            several = f"{len(problems)} of {count} shards are damaged, first {problems[0]}"
            raise ProjectError(problems[0] if len(problems) == 1 else several)
        console.line(f"{self.folder}: {count} shards, all as their checksums say")


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
