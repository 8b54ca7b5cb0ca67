"""Generated pixels against the truth: fillers, hint features, student and teacher."""

from __future__ import annotations

from typing import Any

from gvtools.completers.base import Completer
from gvtools.evaluation.perceptual_distance import NAME, SqueezeNetDistance
from gvtools.evaluation.tables import Table
from pipelines.experiments.cases import SIZE, held_out_cases
from pipelines.experiments.classical import CLASSICAL
from pipelines.experiments.judging import best, judge, records, table
from pipelines.experiments.options import ExperimentOptions
from pipelines.experiments.rows import HINTS, classical_rows, geoverse


def run(options: ExperimentOptions) -> tuple[dict[str, Any], list[Table]]:
    """Figures and tables; reads weights, teacher, scenes, size and seed."""
    side = options.size or SIZE
    methods: dict[str, Completer] = classical_rows()
    methods[HINTS] = geoverse(options.weights, steps=0)
    methods["student 1+1"] = geoverse(options.weights, steps=1)
    methods["student 3+1"] = geoverse(options.weights)
    if options.teacher is not None:
        methods["teacher 3+1, undistilled"] = geoverse(options.teacher)
        methods["teacher 24+1"] = geoverse(options.teacher, steps=24)
    cases = held_out_cases(options.scenes, seed=options.seed, size=side)
    judged = judge(methods, cases, distance=SqueezeNetDistance(), seed=options.seed)
    peers = {figure: best(judged, CLASSICAL, figure) for figure in ("psnr", "depth", "distance")}
    found = {
        "scenes": options.scenes,
        "size": side,
        "seed": options.seed,
        "perceptual_distance": NAME,
        "best_filler": peers,
        "results": records(judged, against=peers["psnr"]),
        "against_hint_features": records(judged, against=HINTS),
    }
    if options.teacher is not None:
        found["against_teacher"] = records(judged, against="teacher 24+1")
    caption = f"Generated pixels of {options.scenes} held-out scenes, {side}x{side}"
    shown = table(judged, caption=caption, against=peers["psnr"], notes=(_note(),))
    return found, [shown]


def _note() -> str:
    return (
        f"Perceptual distance: {NAME}, mean of its map over generated pixels. Depth: relative "
        "error. Intervals: paired bootstrap over scenes."
    )
