"""``gvtools judge``: pictures that any method made, with the figures of ``gvtools evaluate``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from pydantic import Field

from gvtools.errors import OptionError
from pipelines.commands.arguments import MeasurementArguments, SceneArguments

if TYPE_CHECKING:
    from pipelines.console import Console
    from pipelines.scoring.method_pictures import JudgeReference

SUMMARY = "judge pictures of any method, several side by side, with the figures of evaluate"
EXAMPLES = (
    "gvtools judge runs/kitchen gsplat/results/kitchen nerfstudio/renders --against runs/kitchen "
    "--out judged",
    "gvtools judge renders --against scans/kitchen --context not:every:8 --targets every:8 "
    "--out judged",
)


class JudgeArguments(MeasurementArguments, SceneArguments):
    """The command's arguments."""

    positional = ("pictures",)

    pictures: tuple[Path, ...]
    """Of one method each: a folder of pictures, a run of gvtools, or what nerfstudio, gsplat or
    NerfBaselines wrote. [PICTURES]"""
    against: Path
    """A finished run (its targets, truths, memory and settings count), or a project. [PROJECT]"""
    name: tuple[str, ...] = ()
    """Of a method, in their order. [NAME]"""
    context: str | None = None
    """Of a project: the views that were given. [SPEC]"""
    targets: str | None = None
    """Of a project: the views that the pictures stand for. [SPEC]"""
    cameras: Path | None = None
    """A TUM, KITTI or EuRoC trajectory with the cameras of the pictures, where they are none of the
    project's; figures that need a truth are left out then. [FILE]"""
    match: Literal["auto", "name", "order"] = "auto"
    """Pictures with views: by name, or by order where no name matches."""
    out: Path
    """For the results. [DIR]"""
    sheet_views: int = Field(12, ge=0)
    """Views on contact sheets. [N]"""


def run(args: JudgeArguments, console: Console) -> None:
    """Match, measure, print, write."""
    from gvtools.files import make_folder, write_json
    from pipelines.scoring.judging import judge
    from pipelines.scoring.method_pictures import method_names

    names = method_names(args.pictures, args.name)
    _check_apart(args.pictures, args.out)
    options = args.measures()
    make_folder(args.out)
    figures = judge(
        args.pictures,
        names,
        _reference(args, console),
        options=options,
        rule=args.match,
        sheet_views=args.sheet_views,
        out=args.out,
        console=console,
    )
    if args.json_ is not None:
        write_json(args.json_, figures)


def _check_apart(pictures: Sequence[Path], out: Path) -> None:
    """Refuse results among the pictures, where the next call would take sheets for pictures."""
    from gvtools.runs.layout import RECORD

    for path in pictures:
        if out.resolve().is_relative_to(path.resolve()) and not (path / RECORD).is_file():
            raise OptionError(f"--out {out}: lies in the pictures {path}; give a folder elsewhere")


def _reference(args: JudgeArguments, console: Console) -> JudgeReference:
    from gvtools.runs.layout import RECORD
    from pipelines.scoring.method_pictures import open_reference, reference_from_context

    if (args.against / RECORD).is_file():
        given = [name for name in ("context", "targets") if getattr(args, name) is not None]
        if given:
            raise OptionError(
                f"--{given[0]}: {args.against} is a run, whose views are its own; leave it out"
            )
        return open_reference(args.against, cameras=args.cameras)
    return reference_from_context(
        args.open_scene(args.against),
        args.out / "memory",
        context=args.context,
        targets=args.targets,
        cameras=args.cameras,
        reading=args.reading(),
        console=console,
    )
