"""gvtools demo: the main job on a sample that needs no download."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pipelines.commands.reconstruct import RunArguments, copy_figures, run_settings
from pipelines.console import Console

SUMMARY = "run the main job on a sample that needs no download"
EXAMPLES = (
    "gvtools demo",
    "gvtools demo --sample motorcycle --out runs/motorcycle",
    "gvtools demo --sample noisy-room",
)
# Steps of the fit unless told otherwise: a first look takes seconds and is the same every time.
FIT_STEPS = 300


class DemoArguments(RunArguments):
    """The sample, which also --dry-run writes and opens, and every option of ``reconstruct``."""

    sample: Literal["room", "noisy-room", "motorcycle"] = "room"
    """noisy-room is the room as a cheap RGB-D camera records it."""
    out: Path | None = None
    """The run's folder. [PATH]"""


def run(args: DemoArguments, console: Console) -> None:
    """Run ``gvtools demo``: write the sample, reconstruct it, say where the results are."""
    config = run_settings(args.settings, texts=args.set, file=args.config)
    default = Path("runs") / f"demo-{args.sample}"
    # Absolute, since the sample's folder is named after it, and "." has no name.
    out = args.out.absolute() if args.out else free_folder(default, resume=args.resume)
    from gvtools.runs.folder import RunDirectory

    RunDirectory(out).refuse_foreign()
    sample = out.with_name(f"{out.name}-sample")
    from gvtools.procedural.room_sample import KERNELS
    from gvtools.scenes.project import open_project
    from pipelines.reconstruction.run import compile_kernels, reconstruct
    from pipelines.report import draw_run

    compile_kernels(config, console, more=(KERNELS,) if args.sample != "motorcycle" else ())
    console.line(f"sample {args.sample}, seed {config.seed}: writing {sample}")
    context, targets = _write(args.sample, sample, config.seed)
    if "context" not in args.settings:
        config = config.replaced(context=",".join(context))
    if "targets" not in args.settings:
        config = config.replaced(targets=",".join(targets))
    if config.refine.seconds is None and config.refine.steps is None:
        config = config.replaced(refine=config.refine.replaced(steps=FIT_STEPS))
    if not {"views_per_round", "rounds"} & args.settings.keys():
        config = config.replaced(views_per_round=4)
    reconstruct(
        open_project(sample),
        config,
        out,
        console=console,
        resume=args.resume,
        dry_run=args.dry_run,
        draw=draw_run,
    )
    copy_figures(args, out)
    if not args.dry_run and (out / "round_001").is_dir():
        console.line(
            f"look at {out / 'growth.png'} and at the pictures in {out}/round_001: guidance_* is "
            "what the completer was given, generated_* what it made of it, after_* what the memory "
            "knows now"
        )


def free_folder(path: Path, *, resume: bool) -> Path:
    """``path``, or the first of path-2, path-3, ... that is not there yet (the last when resuming).

    A demo is run again and again; its default folder must not refuse.
    """
    candidate = path
    last = path
    number = 2
    while candidate.exists():
        last = candidate
        candidate = path.with_name(f"{path.name}-{number}")
        number += 1
    return last if resume and last.exists() else candidate


def _write(name: str, folder: Path, seed: int) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Write the sample; returns the names of context and targets."""
    if name == "room":
        from gvtools.procedural.room_sample import write_room

        room = write_room(folder, seed=seed)
        return room.context, room.targets
    if name == "noisy-room":
        from gvtools.procedural.noisy_room import write_noisy_room

        noisy = write_noisy_room(folder, seed=seed)
        return noisy.context, noisy.targets
    from gvtools.procedural.stereo_sample import write_motorcycle

    pair = write_motorcycle(folder)
    return pair.context, pair.targets
