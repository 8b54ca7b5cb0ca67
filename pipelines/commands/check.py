"""``gvtools check``: what a run would read of a project, and what is wrong with it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from gvtools.errors import GvError, ProjectError
from pipelines.commands.arguments import SceneArguments

if TYPE_CHECKING:
    from gvtools.scenes.inspection import SceneReport
    from pipelines.console import Console

SUMMARY = "tell what a run would read of a project, and what is wrong with it"
EXAMPLES = ("gvtools check my_colmap_workspace", "gvtools check scans/kitchen --json check.json")

LEVELS = ("error", "warning", "info")


class CheckArguments(SceneArguments):
    """The command's arguments."""

    positional = ("project",)

    project: Path
    """A folder, a transforms.json or spec:NAME:SCENE. [PROJECT]"""
    json_: Path | None = None
    """Write the report there. [FILE]"""


def run(args: CheckArguments, console: Console) -> None:
    """Open every file of the project and report."""
    from gvtools.files import write_json
    from gvtools.scenes.inspection import inspect

    try:
        result = inspect(args.open_scene(args.project))
    except GvError as error:
        if args.json_ is not None:
            finding = {"level": "error", "message": str(error)}
            write_json(args.json_, {"root": str(args.project), "ok": False, "findings": [finding]})
        raise
    if args.json_ is not None:
        write_json(args.json_, result.to_dict())
        console.line(f"report written to {args.json_}")
    else:
        _print(result, console)
    errors = [finding.message for finding in result.findings if finding.level == "error"]
    if not result.ok:
        raise ProjectError(
            f"{args.project}: not ok: {len(errors)} errors, first: {errors[0]}; mend it and check "
            "again"
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
