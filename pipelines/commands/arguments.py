"""Arguments that commands share, and what they say: projects, figures, LPIPS, settings, actions."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from gvtools.errors import OptionError
from gvtools.scenes.layout import FORM, is_address

if TYPE_CHECKING:
    from gvtools.evaluation.lpips_distance import Lpips
    from gvtools.scenes.scene import Scene
    from gvtools.settings import Settings
    from pipelines.console import Console
    from pipelines.scoring.measurement import MeasureOptions


def add_scene_arguments(parser: argparse.ArgumentParser) -> None:
    """Options that say where pictures and masks are, and what RGB-D folders leave open."""
    group = parser.add_argument_group("project")
    add_root_argument(group)
    group.add_argument(
        "--images", type=Path, metavar="DIR", help="the pictures, where they are not beside a model"
    )
    group.add_argument(
        "--masks", type=Path, metavar="DIR", help="masks NAME.png (black = ignore) of the pictures"
    )
    group.add_argument(
        "--model", type=int, metavar="N", help="COLMAP's sparse/N, where it holds several (largest)"
    )
    add_rgbd_arguments(group)


def add_rgbd_arguments(group: argparse._ActionsContainer) -> None:
    """Options that say what RGB-D folders leave open."""
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


def add_root_argument(parser: argparse._ActionsContainer) -> None:
    """The option that says where a data set lies, for projects given as spec:NAME:SCENE."""
    parser.add_argument(
        "--root",
        type=Path,
        metavar="DIR",
        help="the data set's download, for a project given as spec:NAME:SCENE (gvtools data list)",
    )


def refuse_root(root: Path | None, paths: Iterable[Path | None]) -> None:
    """Refuse --root where none of the given paths is a scene of a data set."""
    if root is not None and not any(path is not None and is_address(path) for path in paths):
        raise OptionError(f"--root {root}: belongs to {FORM}; expected that, or no --root")


def open_scene(path: Path, args: argparse.Namespace) -> Scene:
    """The project at ``path``, read with the options of ``add_scene_arguments``."""
    from gvtools.scenes.project import open_as

    return open_as(path, reading_of(args))


def reading_of(args: argparse.Namespace) -> dict[str, Any]:
    """The options of ``add_scene_arguments`` that were given, JSON-ready."""
    from gvtools.scenes.project import READING

    return _given(args, READING)


def rgbd_reading_of(args: argparse.Namespace) -> dict[str, Any]:
    """The options of ``add_rgbd_arguments`` that were given, JSON-ready."""
    from gvtools.scenes.project import READING

    return _given(args, [name for name, option in READING.items() if option is not None])


def _given(args: argparse.Namespace, names: Iterable[str]) -> dict[str, Any]:
    values = {name: getattr(args, name) for name in names}
    return {
        name: str(value.resolve()) if isinstance(value, Path) else value
        for name, value in values.items()
        if value is not None
    }


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


MATCHERS = ("sift", "lightglue")


def add_measurement_arguments(parser: argparse.ArgumentParser) -> None:
    """``--json``, ``--parts``, ``--no-control`` and ``--matcher``."""
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures there too")
    parser.add_argument(
        "--parts",
        default="images,consistency,poses",
        metavar="NAMES",
        help="what to measure (default %(default)s)",
    )
    parser.add_argument(
        "--no-control",
        action="store_true",
        help="leave out the same measures on the true pictures, which tell how to read the figures",
    )
    parser.add_argument(
        "--matcher", choices=MATCHERS, default="sift", help="of the pose probe (default sift)"
    )


def add_lpips_arguments(parser: argparse.ArgumentParser) -> None:
    """Network and weights."""
    parser.add_argument(
        "--lpips-net", choices=("vgg", "alex"), default="vgg", help="below LPIPS (default vgg)"
    )
    parser.add_argument(
        "--lpips-weights",
        type=Path,
        metavar="DIR",
        help="the folder with the network's published weights (default: torch's cache)",
    )


def open_lpips(args: argparse.Namespace) -> tuple[Lpips | None, str | None]:
    """The network, or None with the reason."""
    from gvtools.errors import CheckpointError
    from gvtools.evaluation.lpips_distance import Lpips

    try:
        return Lpips(args.lpips_net, folder=args.lpips_weights), None
    except CheckpointError as error:
        if args.lpips_weights is not None:
            raise
        return None, str(error)


def measure_options(args: argparse.Namespace) -> MeasureOptions:
    """What ``add_measurement_arguments`` and ``add_lpips_arguments`` ask for, with ``--seed``."""
    from pipelines.scoring.measurement import PARTS, MeasureOptions

    if args.seed < 0:
        raise OptionError(f"--seed {args.seed}; expected at least 0")
    parts = tuple(part.strip() for part in args.parts.split(",") if part.strip())
    if not parts or set(parts) - set(PARTS):
        raise OptionError(f"--parts {args.parts!r}; expected some of {', '.join(PARTS)}")
    lpips, no_lpips = open_lpips(args)
    return MeasureOptions(
        parts=parts,
        lpips=lpips,
        no_lpips=no_lpips,
        lpips_net=args.lpips_net,
        matcher=args.matcher,
        control=not args.no_control,
        seed=args.seed,
    )


class HelpSettings(argparse.Action):
    """Like ``--help``, of settings.

    Args:
        settings: gives the settings of a command and those of its parts, when they are asked for;
            takes what was given on the command line before.
        options: of the option, see ``argparse.Action``.
    """

    def __init__(
        self, *, settings: Callable[[argparse.Namespace], Sequence[Settings]], **options: Any
    ) -> None:
        super().__init__(**options, nargs=0)
        self._settings = settings

    def __call__(
        self, parser: argparse.ArgumentParser, namespace: argparse.Namespace, *args: object
    ) -> None:
        """Print them to standard output and end the program with status 0."""
        from gvtools.errors import GvError
        from gvtools.settings import listing

        try:
            print(listing(*self._settings(namespace)))
        except GvError as error:
            parser.error(str(error))
        parser.exit()


AddOption = Callable[..., Any]


class Action(NamedTuple):
    """One of them."""

    run: Callable[[argparse.Namespace, Console], None]  # does it
    add_options: Callable[[AddOption], None]  # given ``parser.add_argument``
    summary: str  # one line
    examples: tuple[str, ...]  # what follows the action's name


def add_actions(parser: argparse.ArgumentParser, command: str, actions: dict[str, Action]) -> None:
    """A parser for each action; ``args.act`` runs the chosen one."""
    parsers = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
    for name, action in actions.items():
        lines = "\n".join(f"  gvtools {command} {name} {x}".rstrip() for x in action.examples)
        added = parsers.add_parser(
            name,
            help=action.summary,
            description=f"examples:\n{lines}\n\n{action.summary}.",
            formatter_class=argparse.RawDescriptionHelpFormatter,
            allow_abbrev=False,
        )
        added.set_defaults(act=action.run)
        # As of every command; given before the action they hold as well.
        for option, text in (("quiet", "print nothing but warnings"), ("debug", "tracebacks")):
            added.add_argument(
                f"--{option}", action="store_true", default=argparse.SUPPRESS, help=text
            )
        action.add_options(added.add_argument)
