"""``gvtools render``: a saved memory seen from cameras, as pictures and as figures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from gvtools.errors import OptionError
from pipelines.commands.arguments import LpipsArguments, SceneArguments

if TYPE_CHECKING:
    from gvtools.cameras import Cameras
    from gvtools.memory.spatial_memory import SpatialMemory
    from gvtools.memory.splat.api import SplatOptions
    from gvtools.scenes.scene import Scene
    from pipelines.console import Console

SUMMARY = "project a saved memory into cameras, and measure it against their pictures"
EXAMPLES = (
    "gvtools render runs/kitchen --cameras scans/kitchen --views every:20 --out renders",
    "gvtools render runs/kitchen --cameras scans/kitchen --views every:20+10 --against-images "
    "--out renders --json figures.json",
)


class RenderArguments(LpipsArguments, SceneArguments):
    """The command's arguments."""

    positional = ("memory",)

    memory: Path
    """A memory.npz or a run. [MEMORY_OR_RUN]"""
    cameras: Path
    """A project whose cameras to take, or a TUM or KITTI trajectory (camera as the memory's first
    view). [PROJECT]"""
    views: str = "all"
    """Which. [SPEC]"""
    out: Path | None = None
    """For the pictures; with --against-images it may be left out, for the figures alone. [DIR]"""
    against_images: bool = False
    """Compare with the project's own pictures."""
    set: tuple[str, ...] = ()
    """A setting of the projection, such as splat.depth_band=0.03. [splat.KEY=VALUE]"""
    backend: str | None = None
    """Short for --set splat.backend=NAME (cpu, torch, ...). [NAME]"""
    device: str | None = None
    """Short for --set splat.device=NAME (auto, cpu, cuda). [NAME]"""
    json_: Path | None = None
    """Write the figures there. [FILE]"""


def run(args: RenderArguments, console: Console) -> None:
    """Project, write pictures, measure."""
    from gvtools.files import write_json
    from gvtools.runs.layout import file_stems
    from gvtools.runs.run import load_appearance, load_memory
    from gvtools.scenes.selection import select
    from pipelines.rendering import measure, render_view, summary, write_view

    if args.out is None and not args.against_images:
        raise OptionError("--out: nothing would be left; give a folder, or --against-images")
    short = {"backend": args.backend, "device": args.device}
    given = [f"splat.{key}={value}" for key, value in short.items() if value is not None]
    options = splat_options([*given, *args.set])
    memory, appearance = load_memory(args.memory), load_appearance(args.memory)
    if not len(memory.views):
        raise OptionError(f"{args.memory}: an empty memory; expected one that views were fused in")
    cameras, scene = _cameras(args, memory)
    if args.against_images and scene is None:
        raise OptionError(
            f"--against-images: {args.cameras} is a trajectory without pictures; give a project"
        )
    names = select(cameras.names, args.views)
    row_of = {name: row for row, name in enumerate(cameras.names)}
    stems = file_stems(names)
    lpips, no_lpips = args.open_lpips() if args.against_images else (None, None)
    # The first projection compiles or loads the kernels and is not timed.
    memory.project(cameras[row_of[names[0]]], options=options)
    views = []
    for name in console.track(names, "rendering"):
        guidance, seconds = render_view(
            memory, cameras[row_of[name]], options, appearance=appearance
        )
        frame = scene[name].load() if scene is not None and args.against_images else None
        if args.out is not None:
            write_view(args.out, stems[name], guidance)
        views.append(measure(name, guidance, frame, seconds=seconds, lpips=lpips))
    figures = summary(views, compared=args.against_images, no_lpips=no_lpips)
    if args.json_ is not None:
        write_json(args.json_, figures)
    else:
        columns = ("view", "psnr", "ssim", "psnr_valid", "ssim_valid", "depth_rel_valid",
                   "coverage", "seconds")  # fmt: skip
        mean = {**figures, "view": "all", "seconds": figures["seconds_per_view"]}
        console.table(columns, [[row[column] for column in columns] for row in [*views, mean]])
        for reason in dict.fromkeys(figures["notes"].values()):
            keys = [key for key, note in figures["notes"].items() if note == reason]
            console.line(f"{', '.join(keys)}: {reason}")
    if args.out is not None:
        console.line(f"{len(views)} views in {args.out}")


def splat_options(texts: Sequence[str]) -> SplatOptions:
    """The projection's options, changed by ``splat.KEY=VALUE`` texts."""
    from gvtools.settings import with_texts
    from pipelines.reconstruction.settings import RunSettings

    for text in texts:
        if not text.strip().startswith("splat."):
            raise OptionError(f"--set {text!r}: render takes splat.KEY=VALUE alone")
    return with_texts(RunSettings(), texts).splat


def _cameras(args: RenderArguments, memory: SpatialMemory) -> tuple[Cameras, Scene | None]:
    if args.cameras.is_file() and args.cameras.suffix.lower() != ".json":
        from gvtools.trajectory_files import read_trajectory

        if args.memory.suffix.lower() == ".ply":
            raise OptionError(
                f"--cameras {args.cameras}: a trajectory takes its camera from the memory's views, "
                f"and {args.memory} is a PLY without any; give the run or its memory.npz"
            )
        photographed = memory.views.photographed
        if not photographed:
            raise OptionError(f"{args.memory}: no photograph's view; give a project as --cameras")
        return read_trajectory(args.cameras, photographed[0].camera), None
    scene = args.open_scene(args.cameras)
    return scene.cameras, scene
