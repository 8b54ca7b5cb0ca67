"""Generated pixels against the truth: fillers, hint features, student and teacher."""

from __future__ import annotations

from contextlib import ExitStack
from typing import Any

from benchmarks.experiments.cases import SIZE, held_out_cases
from benchmarks.experiments.classical import CLASSICAL
from benchmarks.experiments.judging import (
    COLUMNS,
    comparisons,
    judge,
    peers,
    perceptual,
    records,
    table,
)
from benchmarks.experiments.options import ExperimentOptions
from benchmarks.experiments.pictures import write_pictures
from benchmarks.experiments.rows import (
    FILL,
    FILLERS,
    HINTS,
    classical_rows,
    geoverse,
    undenoised_rows,
    with_heads_of,
)
from gvtools.completers.base import Completer
from gvtools.evaluation.tables import Table
from gvtools.procedural.textures import photograph_names

READS = ("weights", "teacher", "scenes", "size", "seed", "pictures")

STUDENT, TEACHER = "student 3+1", "teacher 24+1"
UNDISTILLED = "teacher 3+1, undistilled"
UNSHARED = f"{STUDENT}, each target's fill by itself"
TEACHERS_HINTS = f"{HINTS}, teacher's heads"


def run(options: ExperimentOptions) -> tuple[dict[str, Any], list[Table]]:
    """Figures and tables; see ``READS``."""
    with ExitStack() as stack:
        methods: dict[str, Completer] = classical_rows() | undenoised_rows(options.weights)
        methods["student 1+1"] = geoverse(options.weights, steps=1)
        methods[STUDENT] = geoverse(options.weights)
        methods[f"{STUDENT}, temperature 1"] = geoverse(options.weights, temperature=1.0)
        methods[f"{STUDENT}, decoded"] = geoverse(options.weights, composition="decoded")
        methods[UNSHARED] = geoverse(options.weights, shared_fill=False)
        if options.teacher is not None:
            # Heads that learned from what a denoiser makes may be worse at what none has made.
            methods[TEACHERS_HINTS] = undenoised_rows(options.teacher)[HINTS]
            teacher = stack.enter_context(with_heads_of(options.teacher, options.weights))
            methods[UNDISTILLED] = geoverse(teacher)
            methods[TEACHER] = geoverse(teacher, steps=24)
            methods[f"{TEACHER}, temperature 1"] = geoverse(teacher, steps=24, temperature=1.0)
        return _judged(options, methods)


def _judged(
    options: ExperimentOptions, methods: dict[str, Completer]
) -> tuple[dict[str, Any], list[Table]]:
    side = options.size or SIZE
    distance, said = perceptual()
    cases = list(held_out_cases(options.scenes, seed=options.seed, size=side))
    judged = judge(methods, cases, distance=distance, seed=options.seed)
    if options.pictures is not None:
        write_pictures(options.pictures, cases, geoverse(options.weights), seed=options.seed)
    against = {
        "best_filler": peers(judged, FILLERS),
        "best_other_filler": peers(judged, CLASSICAL),
        "hint_features": dict.fromkeys(COLUMNS, HINTS),
        "teachers_hint_features": dict.fromkeys(COLUMNS, TEACHERS_HINTS),
        "teacher": dict.fromkeys(COLUMNS, TEACHER),
    }
    found: dict[str, Any] = {
        "scenes": options.scenes,
        "size": side,
        "seed": options.seed,
        "photographs": list(photograph_names("held-out")),
        "perceptual_distance": said,
    }
    for name, rows in against.items():
        if set(rows.values()) <= set(judged):
            found[f"against_{name}"] = records(judged, against=rows)
    caption = f"Generated pixels of {options.scenes} held-out scenes, {side}x{side}"
    shown = table(judged, caption=caption, against=against["best_filler"], notes=(_note(said),))
    pairs = [
        (row, said, against[key])
        for row in ("student 1+1", STUDENT)
        for said, key in (
            ("best classical filler", "best_filler"),
            ("best other than this project's", "best_other_filler"),
            ("hint features decoded", "hint_features"),
            (TEACHER, "teacher"),
        )
    ]
    pairs += [
        (STUDENT, other, dict.fromkeys(COLUMNS, other)) for other in (UNDISTILLED, FILL, UNSHARED)
    ]
    return found, [shown, comparisons(judged, pairs, caption="Differences, two by two")]


def _note(distance: str) -> str:
    return (
        f"Perceptual distance: {distance}; mean of its map over generated pixels. Depth: relative "
        "error. Differences: to the best filler of each figure, 95 % of the paired bootstrap over "
        "scenes. Teachers have the student's heads."
    )
