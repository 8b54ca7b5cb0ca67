"""``gvtools judge``: pictures that any method made, with the figures of ``gvtools evaluate``."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from gvtools.errors import OptionError
from pipelines.commands.arguments import (
    add_lpips_arguments,
    add_measurement_arguments,
    add_scene_arguments,
    measure_options,
)

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
MATCHES = ("auto", "name", "order")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The command's options."""
    parser.add_argument(
        "pictures",
        type=Path,
        nargs="+",
        metavar="PICTURES",
        help="of one method each: a folder of pictures, a run of gvtools, or what nerfstudio, "
        "gsplat or NerfBaselines wrote",
    )
    parser.add_argument(
        "--against",
        type=Path,
        required=True,
        metavar="PROJECT",
        help="a finished run (its targets, truths, memory and settings count), or a project",
    )
    parser.add_argument(
        "--name", action="append", default=[], metavar="NAME", help="of a method, in their order"
    )
    parser.add_argument("--context", metavar="SPEC", help="of a project: the views that were given")
    parser.add_argument(
        "--targets", metavar="SPEC", help="of a project: the views that the pictures stand for"
    )
    parser.add_argument(
        "--cameras",
        type=Path,
        metavar="FILE",
        help="a TUM, KITTI or EuRoC trajectory with the cameras of the pictures, where they are "
        "none of the project's; figures that need a truth are left out then",
    )
    parser.add_argument(
        "--match",
        choices=MATCHES,
        default="auto",
        help="pictures with views: by name, or by order where no name matches (default auto)",
    )
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="for the results")
    add_measurement_arguments(parser)
    parser.add_argument(
        "--sheet-views", type=int, default=12, metavar="N", help="views on contact sheets (12)"
    )
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="of everything random (0)")
    add_lpips_arguments(parser)
    add_scene_arguments(parser)


def run(args: argparse.Namespace, console: Console) -> None:
    """Match, measure, print, write."""
    from gvtools.files import make_folder, write_json
    from pipelines.scoring.judging import judge
    from pipelines.scoring.method_pictures import method_names

    if args.sheet_views < 0:
        raise OptionError(f"--sheet-views {args.sheet_views}; expected at least 0")
    names = method_names(args.pictures, args.name)
    _check_apart(args.pictures, args.out)
    options = measure_options(args)
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
    if args.json is not None:
        write_json(args.json, figures)


def _check_apart(pictures: Sequence[Path], out: Path) -> None:
    """Refuse results among the pictures, where the next call would take sheets for pictures."""
    from gvtools.runs.layout import RECORD

    for path in pictures:
        if out.resolve().is_relative_to(path.resolve()) and not (path / RECORD).is_file():
            raise OptionError(f"--out {out}: lies in the pictures {path}; give a folder elsewhere")


def _reference(args: argparse.Namespace, console: Console) -> JudgeReference:
    from gvtools.runs.layout import RECORD
    from pipelines.commands.arguments import open_scene, reading_of
    from pipelines.scoring.method_pictures import open_reference, reference_from_context

    if (args.against / RECORD).is_file():
        given = [name for name in ("context", "targets") if getattr(args, name) is not None]
        if given:
            raise OptionError(
                f"--{given[0]}: {args.against} is a run, whose views are its own; leave it out"
            )
        return open_reference(args.against, cameras=args.cameras)
    return reference_from_context(
        open_scene(args.against, args),
        args.out / "memory",
        context=args.context,
        targets=args.targets,
        cameras=args.cameras,
        reading=reading_of(args),
        console=console,
    )
