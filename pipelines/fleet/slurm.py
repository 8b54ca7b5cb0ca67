"""The same list for Slurm: an array job for each stage, and the script that submits them."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

from gvtools.files import make_folder, write_text
from pipelines.fleet.spec import Task
from pipelines.fleet.task import write_tasks

TASKS, SUBMIT = "tasks.json", "submit.sh"


def write_slurm(tasks: Sequence[Task], folder: Path) -> Path:
    """Write the list of tasks, a job script for each stage, and the script to start; returns that.

    Task N of a stage's array is scene N; it begins when scene N has passed the stage before.
    """
    make_folder(folder / "slurm-logs")
    write_tasks(folder / TASKS, list(tasks))
    stages: dict[str, list[int]] = {}
    for number, task in enumerate(tasks):
        stages.setdefault(task.stage, []).append(number)
    lines = ["#!/bin/bash", "# Submits the stages; extra options of sbatch may follow.", "set -e"]
    wait = ""
    for name, numbers in stages.items():
        script = folder / f"stage-{name}.sh"
        write_text(script, _job(tasks[numbers[0]], numbers, folder))
        lines.append(f'job=$(sbatch --parsable {wait}"$@" {shlex.quote(str(script))})')
        lines.append(f'echo "{name}: job $job"')
        wait = '--dependency=aftercorr:"${job%%;*}" --kill-on-invalid-dep=yes '
    write_text(folder / SUBMIT, "\n".join(lines) + "\n")
    return folder / SUBMIT


def _job(task: Task, numbers: Sequence[int], folder: Path) -> str:
    asked = [
        f"--job-name=gvtools-{task.stage}",
        f"--array=0-{len(numbers) - 1}",
        f"--cpus-per-task={task.cpus}",
        "--requeue",
        f"--output={folder}/slurm-logs/{task.stage}-%A_%a.log",
    ]
    if task.memory_gb:
        asked.append(f"--mem={-(-task.memory_gb * 1000 // 1):.0f}M")
    if task.gpus:
        asked.append(f"--gres=gpu:{-(-task.gpus // 1):.0f}")
    run = (
        f"{shlex.quote(sys.executable)} -m pipelines.fleet.task {shlex.quote(str(folder / TASKS))}"
    )
    heads = "\n".join(f"#SBATCH {option}" for option in asked)
    return (
        f"#!/bin/bash\n{heads}\n\n"
        f"# Tasks {numbers[0]} to {numbers[-1]} of the list are this stage's.\n"
        f"exec {run} $(({numbers[0]} + SLURM_ARRAY_TASK_ID))\n"
    )
