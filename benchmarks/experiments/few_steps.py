"""Quality against steps: level 1 from 49 to 1 with one cascade step, and the cascade's own."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import Any

from benchmarks.experiments.cases import SIZE, held_out_cases
from benchmarks.experiments.judging import judge, perceptual, records, table
from benchmarks.experiments.options import ExperimentOptions
from benchmarks.experiments.rows import geoverse, with_heads_of
from gvtools.completers.base import Completer
from gvtools.evaluation.tables import Table

READS = ("weights", "teacher", "scenes", "size", "seed")

LEVEL1 = (49, 24, 12, 6, 3, 2, 1)
CASCADE = (1, 2, 4, 8, 24)
SWEPT = {
    "level 1": "the level 1 steps",
    "cascade": "the cascade steps",
}


def run(options: ExperimentOptions) -> tuple[dict[str, Any], list[Table]]:
    """Figures and tables; see ``READS``. The teacher has the student's heads."""
    with ExitStack() as stack:
        models = {"student": options.weights}
        if options.teacher is not None:
            folder = stack.enter_context(with_heads_of(options.teacher, options.weights))
            models["teacher"] = folder
        return _swept(options, models)


def _swept(
    options: ExperimentOptions, models: dict[str, Path | None]
) -> tuple[dict[str, Any], list[Table]]:
    side = options.size or SIZE
    found: dict[str, Any] = {"scenes": options.scenes, "size": side, "seed": options.seed}
    tables = []
    distance, found["perceptual_distance"] = perceptual()
    for name, folder in models.items():
        sweeps: dict[str, dict[str, Completer]] = {
            "level 1": {
                "3+1, own bounds": geoverse(folder),
                **{f"{n}+1, equal steps": geoverse(folder, steps=n) for n in LEVEL1},
            },
            "cascade": {f"3+{n}, own bounds": geoverse(folder, cascade_steps=n) for n in CASCADE},
        }
        for sweep, methods in sweeps.items():
            cases = held_out_cases(options.scenes, seed=options.seed, size=side)
            judged = judge(methods, cases, distance=distance, seed=options.seed)
            found[f"{name}, {sweep}"] = records(judged)
            caption = f"{name}, sweep of {SWEPT[sweep]}, {options.scenes} held-out scenes"
            tables.append(table(judged, caption=caption))
    return found, tables
