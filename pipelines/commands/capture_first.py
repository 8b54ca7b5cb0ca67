"""``gvtools reconstruct`` of an input without cameras: ``gvtools capture`` comes first."""

from __future__ import annotations

import argparse
import json
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gvtools.errors import OptionError, UnposedError
from pipelines.commands.arguments import open_scene, reading_of, rgbd_reading_of

if TYPE_CHECKING:
    from gvtools.scenes.scene import Scene
    from pipelines.console import Console


def open_or_capture(args: argparse.Namespace, console: Console) -> tuple[Scene, dict[str, Any]]:
    """The scene that ``reconstruct`` is asked for, and how it is read.

    An input without cameras is captured to ``OUT-project`` beside the run's folder where --capture
    or the user's answer says so. A project that was captured from this input before is used again.
    """
    try:
        return open_scene(args.project, args), reading_of(args)
    except UnposedError as error:
        unposed = error
    project = args.out.with_name(f"{args.out.name}-project")
    if _is_of(project, args.project):
        console.line(f"{args.project}: {unposed.found}; captured before: {project}")
    else:
        _capture(args, project, console=console, unposed=unposed)
    # What the options say of RGB-D is in the captured project.
    reading = {
        name: value for name, value in reading_of(args).items() if name not in rgbd_reading_of(args)
    }
    from gvtools.scenes.reading import open_as

    return open_as(project, reading), reading


def _capture(
    args: argparse.Namespace, project: Path, *, console: Console, unposed: UnposedError
) -> None:
    from pipelines.commands import capture

    source, out = (shlex.quote(str(path)) for path in (args.project, project))
    command = f"gvtools capture {source} --out {out}"
    if args.dry_run:
        raise UnposedError(args.project, unposed.found, f"a run would find them first: {command}")
    if not args.capture and not console.ask(
        f"{args.project}: {unposed.found}. Capture now to {project}?"
    ):
        raise UnposedError(
            args.project, unposed.found, f"find the cameras first: {command}; or add --capture"
        )
    for name in ("images", "model"):
        if getattr(args, name) is not None:
            raise OptionError(
                f"--{name}: of a COLMAP project; {args.project} has {unposed.found}; leave it out"
            )
    given = {name: getattr(args, name) for name in rgbd_reading_of(args)}
    parser = argparse.ArgumentParser()
    capture.add_arguments(parser)
    captured = parser.parse_args([str(args.project), "--out", str(project)])
    vars(captured).update(masks=args.masks, **given)
    capture.run(captured, console)


def _is_of(project: Path, source: Path) -> bool:
    """Whether a project was captured from an input."""
    from gvtools.capture.project import REPORT

    try:
        report = json.loads((project / REPORT).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return isinstance(report, dict) and report.get("source") == str(source.resolve())
