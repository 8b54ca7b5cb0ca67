"""Generated pixels against the truth: fillers, hint features, student and teacher."""

from __future__ import annotations

from typing import Any

from gvtools.completers.base import Completer
from gvtools.evaluation.tables import Table
from pipelines.experiments.cases import SIZE, held_out_cases
from pipelines.experiments.classical import CLASSICAL
from pipelines.experiments.judging import COLUMNS, judge, peers, perceptual, records, table
from pipelines.experiments.options import ExperimentOptions
from pipelines.experiments.pictures import write_pictures
from pipelines.experiments.rows import FILLERS, HINTS, classical_rows, geoverse, undenoised_rows

TEACHERS_HINTS = f"{HINTS}, teacher's heads"


def run(options: ExperimentOptions) -> tuple[dict[str, Any], list[Table]]:
    """Figures and tables; reads weights, teacher, scenes, size, seed, pictures."""
    side = options.size or SIZE
    methods: dict[str, Completer] = classical_rows() | undenoised_rows(options.weights)
    methods["student 1+1"] = geoverse(options.weights, steps=1)
    methods["student 3+1"] = geoverse(options.weights)
    methods["student 3+1, decoded"] = geoverse(options.weights, composition="decoded")
    if options.teacher is not None:
        # Heads that learned from what a denoiser makes may be worse at what none has made.
        methods[TEACHERS_HINTS] = undenoised_rows(options.teacher)[HINTS]
        methods["teacher 3+1, undistilled"] = geoverse(options.teacher)
        methods["teacher 24+1"] = geoverse(options.teacher, steps=24)
    distance, said = perceptual()
    cases = list(held_out_cases(options.scenes, seed=options.seed, size=side))
    judged = judge(methods, cases, distance=distance, seed=options.seed)
    if options.pictures is not None:
        write_pictures(options.pictures, cases, geoverse(options.weights), seed=options.seed)
    found = {
        "scenes": options.scenes,
        "size": side,
        "seed": options.seed,
        "perceptual_distance": said,
        "against_best_filler": records(judged, against=peers(judged, FILLERS)),
        "against_best_other_filler": records(judged, against=peers(judged, CLASSICAL)),
        "against_hint_features": records(judged, against=dict.fromkeys(COLUMNS, HINTS)),
    }
    if options.teacher is not None:
        found["against_teachers_hint_features"] = records(
            judged, against=dict.fromkeys(COLUMNS, TEACHERS_HINTS)
        )
        found["against_teacher"] = records(judged, against=dict.fromkeys(COLUMNS, "teacher 24+1"))
    caption = f"Generated pixels of {options.scenes} held-out scenes, {side}x{side}"
    against = peers(judged, FILLERS)
    return found, [table(judged, caption=caption, against=against, notes=(_note(said),))]


def _note(distance: str) -> str:
    return (
        f"Perceptual distance: {distance}; mean of its map over generated pixels. Depth: relative "
        "error. Differences: to the best filler of each figure, 95 % of the paired bootstrap over "
        "scenes."
    )
