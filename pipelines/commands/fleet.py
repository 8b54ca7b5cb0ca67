"""``gvtools fleet``: many scenes on one machine, a Ray cluster or Slurm."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from gvtools.errors import OptionError, ProjectError
from pipelines.options import Arguments

if TYPE_CHECKING:
    from pipelines.console import Console
    from pipelines.fleet.spec import Task
    from pipelines.scoring.sweep import Pool

SUMMARY = "run commands over many scenes: on Ray, under Slurm, or on this machine"
EXAMPLES = (
    "gvtools fleet scenes.yaml --address auto --out runs/fleet",
    "gvtools fleet scenes.yaml --engine slurm --out /shared/fleet",
    "gvtools fleet scenes.yaml --collect --out /shared/fleet",
)


class FleetArguments(Arguments):
    """The command's arguments."""

    positional = ("scenes",)

    scenes: Path
    """Stages and scenes. [SCENES.yaml]"""
    out: str
    """Of the results, a path or URL; goes on there. [FOLDER]"""
    engine: Literal["ray", "processes", "slurm"] = "ray"
    """What runs the commands."""
    address: str | None = None
    """Ray's cluster: auto (the one that runs here), HOST:PORT, or local, a new one on this machine
    (default local). [WHERE]"""
    collect: bool = False
    """Run nothing; gather the results that are there."""


def run(args: FleetArguments, console: Console) -> None:
    """Run what is not finished, and print one table."""
    from gvtools.runs.folder import folder_lock
    from pipelines.fleet.run import jobs_of, report, run_fleet, write_slurm
    from pipelines.fleet.spec import is_url, read_list, tasks_of

    if args.address is not None and args.engine != "ray":
        raise OptionError(f"--address: belongs to --engine ray, not {args.engine}")
    root = args.out.rstrip("/") if is_url(args.out) else str(Path(args.out).absolute())
    tasks = tasks_of(read_list(args.scenes), root, folder=args.scenes.absolute().parent)
    if args.engine == "slurm" and not args.collect:
        if is_url(root):
            raise OptionError(f"--out {root}: expected a shared folder, which job scripts lie in")
        script = write_slurm(tasks, Path(root))
        console.line(f"{len(tasks)} tasks; submit them with: bash {script}")
        console.line("then, when they have run: the same command with --collect")
        return
    # A second driver would begin the same commands; of a URL, the user has to take care.
    alone = nullcontext() if args.collect or is_url(root) else folder_lock(Path(root))
    with alone:
        jobs = [] if args.collect else jobs_of(tasks)
        left = [job.work for job in jobs if job.record is None]
        if left:
            run_fleet(jobs, _pool(left, args, console), console=console)
        elif jobs:
            console.line(f"all {len(tasks)} tasks were finished before")
        failed = report(tasks, root, console)
    if failed:
        first = failed[0]
        raise ProjectError(
            f"{args.out}: {len(failed)} of {len(tasks)} tasks are not done, first {first['scene']} "
            f"{first['stage']}: {first['reason']}; the same command tries them again"
        )


def _pool(left: list[Task], args: FleetArguments, console: Console) -> Pool:
    from pipelines.fleet.run import Ray, this_machine

    if args.engine == "processes":
        return this_machine(left)
    return Ray(left, address=args.address or "local", console=console)
