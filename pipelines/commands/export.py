"""``gvtools export``: a memory for other tools, in the input's world frame."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from gvtools.errors import OptionError

if TYPE_CHECKING:
    from gvtools.memory.spatial_memory import SpatialMemory
    from pipelines.console import Console
    from pipelines.export.cameras import Written

SUMMARY = "write a memory as PLY, COLMAP model, transforms.json or GLB, in the input's frame"
EXAMPLES = (
    "gvtools export runs/kitchen --format ply --out kitchen.ply --max-points 2000000",
    "gvtools export runs/kitchen --format colmap --out kitchen_colmap",
)

FORMATS = ("ply", "colmap", "transforms", "glb")
# Where a format's readers are slow or give up, unless --max-points says otherwise.
MAX_POINTS = {"colmap": 200_000, "glb": 2_000_000}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The command's options."""
    parser.add_argument("memory", type=Path, metavar="RUN_OR_MEMORY", help="a run or a memory.npz")
    parser.add_argument("--format", choices=FORMATS, required=True, help="what to write")
    parser.add_argument(
        "--out",
        type=Path,
        required=True,
        metavar="PATH",
        help="ply, glb: a file; colmap: a folder, the model goes to its sparse/0; transforms: a "
        "folder or a .json file",
    )
    parser.add_argument(
        "--max-points",
        type=int,
        metavar="N",
        help="thin to at most N points, one a voxel (ply: all; colmap: 200000; glb: 2 million)",
    )
    parser.add_argument("--round", type=int, metavar="R", help="the memory as it was after round R")
    parser.add_argument(
        "--images",
        default="images",
        metavar="DIR",
        help="transforms: where the observed views' pictures are (%(default)s, beside the file); "
        "undistorted ones, if the project's were distorted",
    )


# How a file of a format begins, which is also what its name has to end with.
MAGIC = {"ply": b"ply", "glb": b"glTF"}


def _refuse_foreign(form: str, memory: Path, out: Path) -> None:
    """Keep the input, and models, transforms and files that no export wrote."""
    from pipelines.export.cameras import foreign_model, foreign_transforms

    if form in MAGIC:
        if out.suffix.lower() != f".{form}":
            raise OptionError(f"--out {out}: expected a name that ends with .{form}")
        if out.is_file():
            with out.open("rb") as file:
                start = file.read(4)
            if not start.startswith(MAGIC[form]) or (memory.is_file() and out.samefile(memory)):
                raise OptionError(
                    f"{out}: is there already and is "
                    + ("the input" if start.startswith(MAGIC[form]) else f"no {form.upper()} file")
                    + "; give another --out"
                )
        return
    found = foreign_model(out) if form == "colmap" else foreign_transforms(out)
    if found is not None:
        raise OptionError(
            f"{found}: is there already and was not written by gvtools export; expected a free "
            "place or an earlier export; give another --out"
        )


def run(args: argparse.Namespace, console: Console) -> None:
    """Write the export.

    Raises:
        GvError: the memory is unreadable, an option is wrong, or the target cannot be written.
    """
    from gvtools.runs.memory_file import load_memory

    if args.max_points is not None and args.max_points < 1:
        raise OptionError(f"--max-points {args.max_points}; expected 1 or more")
    if args.format == "transforms" and args.max_points is not None:
        raise OptionError("--max-points: a transforms.json holds no points; leave it out")
    if args.format in ("colmap", "transforms") and args.memory.suffix.lower() == ".ply":
        raise OptionError(
            f"--format {args.format}: {args.memory} is a PLY, which holds no cameras; give the "
            "run's folder or its memory.npz"
        )
    _refuse_foreign(args.format, args.memory, args.out)
    memory = load_memory(args.memory, up_to=args.round)
    if not len(memory):
        raise OptionError(f"{args.memory}: an empty memory; expected one that views were fused in")
    limit = args.max_points if args.max_points is not None else MAX_POINTS.get(args.format)
    if args.format == "ply":
        _ply(memory, args.out, limit, console=console)
    elif args.format == "glb":
        _glb(memory, args.out, limit, console=console)
    elif args.format == "colmap":
        from pipelines.export.cameras import write_colmap_export

        written = write_colmap_export(memory, args.out, max_points=limit, run=args.memory)
        console.line(
            f"{_views(written)}, {written.points} points of "
            f"{len(memory)} observations (voxels of {written.edge:.4g}), {written.elements} track "
            f"elements in {args.out}/sparse/0; no pictures are copied"
        )
    else:
        from pipelines.export.cameras import write_transforms_export

        written = write_transforms_export(memory, args.out, images=args.images, run=args.memory)
        console.line(f"{_views(written)} in {args.out}")


def _views(written: Written) -> str:
    return f"{written.views} views ({written.generated} generated)"


def _ply(memory: SpatialMemory, path: Path, limit: int | None, *, console: Console) -> None:
    from gvtools.memory.io.ply import export_memory_ply

    points, edge = export_memory_ply(memory, path, max_points=limit)
    thinned = f", thinned to voxels of {edge:.4g}" if edge else ""
    console.line(f"{points} of {len(memory)} observations{thinned} in {path}")


def _glb(memory: SpatialMemory, path: Path, limit: int | None, *, console: Console) -> None:
    from pipelines.export.glb import write_glb

    points, edge = write_glb(memory, path, max_points=limit)
    console.line(
        f"{points} points of {len(memory)} observations (voxels of {edge:.4g}) in {path}, in the "
        "input's axes"
    )
