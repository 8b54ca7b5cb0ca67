"""``gvtools export``: a run or a memory for other tools, in the input's world frame."""

from __future__ import annotations

import argparse
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING

from gvtools.errors import OptionError
from pipelines.export.formats import FORMATS, ExportFormat

if TYPE_CHECKING:
    from pipelines.console import Console
    from pipelines.export.source import ExportOptions

SMALLEST_TEXTURE, LARGEST_TEXTURE = 64, 4096
SUMMARY = "write a run as point cloud, splats, mesh, cameras or recording, in the input's frame"
EXAMPLES = (
    "gvtools export runs/kitchen --format splat --out kitchen.ply",
    "gvtools export runs/kitchen --format mesh --out kitchen.glb --max-triangles 200000",
    "gvtools export runs/kitchen --format las --out kitchen.laz --observed",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The command's options."""
    formats = "; ".join(
        f"{each.name}: {each.holds}" + (f" ({', '.join(each.suffixes)})" if each.suffixes else "")
        for each in FORMATS.values()
    )
    parser.add_argument("memory", type=Path, metavar="RUN_OR_MEMORY", help="a run or a memory.npz")
    parser.add_argument("--format", choices=FORMATS, required=True, help=formats)
    parser.add_argument(
        "--out",
        type=Path,
        required=True,
        metavar="PATH",
        help="a file of the format; colmap: a folder, the model goes to its sparse/0; transforms: "
        "a folder or a .json file",
    )
    parser.add_argument("--round", type=int, metavar="R", help="the memory as it was after round R")
    parser.add_argument(
        "--max-points",
        type=int,
        metavar="N",
        help="thin to at most N points, one a voxel (ply: all; colmap: 200000; rrd: 1 million; "
        "glb, usd: 2 million; otherwise the memory's voxels)",
    )
    parser.add_argument(
        "--observed", action="store_true", default=None, help="leave out what a completer made"
    )
    parser.add_argument("--method", choices=("tsdf", "poisson"), help="mesh: how it is made (tsdf)")
    parser.add_argument(
        "--voxel",
        type=float,
        metavar="EDGE",
        help="mesh: edge of the voxels that it is made in, scene units (from the memory's)",
    )
    parser.add_argument(
        "--max-triangles", type=int, metavar="N", help="mesh: simplify to at most N triangles"
    )
    parser.add_argument(
        "--texture",
        type=int,
        metavar="SIDE",
        help=f"mesh (.glb, .obj): colours from the run's photographs, in a picture of SIDE x SIDE "
        f"({SMALLEST_TEXTURE} to {LARGEST_TEXTURE}); one triangle for 80 of its pixels, unless "
        "--max-triangles says otherwise",
    )
    parser.add_argument(
        "--images",
        metavar="DIR",
        help="transforms: where the observed views' pictures are (images, beside the file); "
        "undistorted ones, if the project's were distorted",
    )


def run(args: argparse.Namespace, console: Console) -> None:
    """Write the export."""
    from gvtools.runs.run import load_memory
    from pipelines.export.source import ExportSource

    form = FORMATS[args.format]
    options = _options(args, form)
    if args.format in ("colmap", "transforms", "mesh") and args.memory.suffix.lower() == ".ply":
        raise OptionError(
            f"--format {args.format}: {args.memory} is a PLY, which holds no cameras; give the "
            "run's folder or its memory.npz"
        )
    form.check_path(args.out, args.memory)
    write = form.load()
    memory = load_memory(args.memory, up_to=args.round)
    if not len(memory):
        raise OptionError(f"{args.memory}: an empty memory; expected one that views were fused in")
    if args.format != "ply" or args.max_points is not None:
        shown = memory.overview()
        if len(shown) < len(memory):
            console.line(
                f"{len(memory):,} observations exceed the memory's budget; {len(shown):,} stand "
                "for them"
            )
        memory = shown
    console.line(write(ExportSource(args.memory, memory, args.round), args.out, options))
    made = memory.generated_count / len(memory)
    if made and "observed" in form.options and not options.observed:
        console.line(
            f"{made:.0%} of the observations are generated: a completer's, or depth that only "
            "fitted Gaussians tell; --observed leaves them out"
        )


def _options(args: argparse.Namespace, form: ExportFormat) -> ExportOptions:
    """What was given, checked."""
    from pipelines.export.source import ExportOptions

    given = {
        field.name: getattr(args, field.name)
        for field in fields(ExportOptions)
        if getattr(args, field.name) is not None
    }
    for name, value in given.items():
        option = f"--{name.replace('_', '-')}"
        if name not in form.options:
            takers = ", ".join(each.name for each in FORMATS.values() if name in each.options)
            raise OptionError(
                f"{option}: --format {form.name} does not take it ({takers} do); leave it out"
            )
        if name in ("max_points", "max_triangles") and value < 1:
            raise OptionError(f"{option} {value}; expected 1 or more")
        if name == "texture" and not SMALLEST_TEXTURE <= value <= LARGEST_TEXTURE:
            raise OptionError(f"{option} {value}; expected {SMALLEST_TEXTURE} to {LARGEST_TEXTURE}")
        if name == "voxel" and not 0 < value < float("inf"):
            raise OptionError(f"{option} {value}; expected a number above 0")
    return ExportOptions(**given)
