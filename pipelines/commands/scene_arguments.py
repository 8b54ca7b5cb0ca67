"""The options by which a command is told what a project does not tell by itself."""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gvtools.errors import OptionError

if TYPE_CHECKING:
    from gvtools.scenes.rgbd_recording import RgbdOptions
    from gvtools.scenes.scene import Scene


def add_scene_arguments(parser: argparse.ArgumentParser) -> None:
    """Options that say where pictures and masks are, and what RGB-D folders leave open."""
    group = parser.add_argument_group("project")
    group.add_argument(
        "--images", type=Path, metavar="DIR", help="the pictures, where they are not beside a model"
    )
    group.add_argument(
        "--masks", type=Path, metavar="DIR", help="masks NAME.png (black = ignore) of the pictures"
    )
    group.add_argument(
        "--depth-unit", type=_positive, metavar="METRES", help="of one stored unit of RGB-D depth"
    )
    group.add_argument(
        "--depth-max", type=_positive, metavar="METRES", help="ignore greater RGB-D readings"
    )
    group.add_argument(
        "--color-intrinsics",
        type=_intrinsics,
        metavar="FX,FY,CX,CY",
        help="of RGB-D pictures, pixels, the first pixel's centre being (0, 0)",
    )
    group.add_argument(
        "--depth-intrinsics",
        type=_intrinsics,
        metavar="FX,FY,CX,CY",
        help="of a depth camera that is not the colour camera; depth is then registered",
    )
    group.add_argument(
        "--color-from-depth",
        type=Path,
        metavar="FILE",
        help="4x4 matrix (text, metres) from the depth camera's frame to the colour camera's",
    )
    group.add_argument(
        "--max-time-difference",
        type=_positive,
        metavar="SECONDS",
        help="between picture, depth and pose of one TUM frame (0.02)",
    )


def open_scene(path: Path, args: argparse.Namespace) -> Scene:
    """The project at ``path``, read with the options of ``add_scene_arguments``.

    Raises:
        GvError: as of ``gvtools.scenes.project.open_project``; OptionError also for a matrix file
            that is none.
    """
    from gvtools.scenes.project import open_project

    return open_project(path, images=args.images, masks=args.masks, rgbd=rgbd_options(args))


_NAMES = ("images", "masks", "depth_unit", "depth_max", "color_intrinsics", "depth_intrinsics",
          "color_from_depth", "max_time_difference")  # fmt: skip
_PATHS = ("images", "masks", "color_from_depth")


def reopen_scene(path: Path, reading: Mapping[str, Any]) -> Scene:
    """The project at ``path``, read as ``reading_of`` recorded.

    Raises:
        GvError: as of ``open_scene``.
    """
    given = {**dict.fromkeys(_NAMES), **reading}
    paths = {name: Path(given[name]) for name in _PATHS if given[name] is not None}
    return open_scene(path, argparse.Namespace(**{**given, **paths}))


def reading_of(args: argparse.Namespace) -> dict[str, Any]:
    """What was given of the options of ``add_scene_arguments``, JSON-ready."""
    given = {name: getattr(args, name) for name in _NAMES}
    return {
        name: str(value.resolve()) if isinstance(value, Path) else value
        for name, value in given.items()
        if value is not None
    }


def rgbd_options(args: argparse.Namespace) -> RgbdOptions | None:
    """The RGB-D options that were given; None when none was.

    Raises:
        OptionError: a matrix file that is none.
    """
    given = {
        "depth_unit": args.depth_unit,
        "depth_max": args.depth_max,
        "color_K": args.color_intrinsics,
        "depth_K": args.depth_intrinsics,
        "max_time_difference": args.max_time_difference,
    }
    if args.color_from_depth is not None:
        given["color_from_depth"] = _matrix(args.color_from_depth)
    given = {name: value for name, value in given.items() if value is not None}
    if not given:
        return None
    from gvtools.scenes.rgbd_recording import RgbdOptions

    return RgbdOptions(**given)


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"{text!r} is no positive number")
    return value


def _intrinsics(text: str) -> list[list[float]]:
    """K of ``FX,FY,CX,CY``."""
    try:
        fx, fy, cx, cy = (float(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"{text!r} is no camera; expected four numbers FX,FY,CX,CY in pixels"
        ) from None
    if not (min(fx, fy) > 0 and all(math.isfinite(value) for value in (fx, fy, cx, cy))):
        raise argparse.ArgumentTypeError(f"{text!r}: expected finite numbers, FX and FY above 0")
    return [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]


def _matrix(path: Path) -> list[list[float]]:
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
        rows = [[float(word) for word in line.replace(",", " ").split()] for line in lines]
    except (OSError, ValueError) as error:
        raise OptionError(
            f"--color-from-depth {path}: unreadable ({error}); expected a text file of 4x4 numbers"
        ) from None
    rows = [row for row in rows if row]
    if [len(row) for row in rows] != [4, 4, 4, 4]:
        raise OptionError(
            f"--color-from-depth {path}: rows of {[len(row) for row in rows]} numbers; expected "
            "four rows of four"
        )
    return rows
