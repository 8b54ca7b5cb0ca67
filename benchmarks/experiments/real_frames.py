"""A recorded scan: some views are the context, views between are judged; with fine-tuning too.

Fine-tuning sees the context views alone, mixed with procedural scenes so that little is forgotten.
It is the denoisers' own training at a low rate, from the student: what few-step sampling was
distilled for may loosen.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.experiments.cases import Case
from benchmarks.experiments.judging import judge, peers, perceptual, records, table
from benchmarks.experiments.options import ExperimentOptions
from benchmarks.experiments.pictures import write_pictures
from benchmarks.experiments.rows import FILLERS, classical_rows, geoverse, undenoised_rows
from gvtools.cameras import concatenate
from gvtools.completers.base import Completer, ContextView
from gvtools.completers.geoverse.completer import SHIPPED
from gvtools.errors import OptionError
from gvtools.evaluation.tables import Table
from gvtools.scenes.scene import Scene, View
from gvtools.scenes.selection import select
from gvtools.settings import with_texts
from gvtools.training.distributed import started
from gvtools.training.hints import Observation, projected
from gvtools.training.options import shipped_or_read
from gvtools.training.run import StageRun
from pipelines.console import Console

READS = ("weights", "project", "seed", "steps", "out", "training", "pictures")

CONTEXT, TARGETS = "every:20", "every:20+10"
# Of a fine-tuning: views of a sample, share of the scan, learning rate, least common depth.
VIEWS, SHARE, RATE, OVERLAP = 2, 0.5, 2e-4, 0.15
# scikit-image's filler takes minutes a picture of this size.
SLOW = "biharmonic"


def run(options: ExperimentOptions) -> tuple[dict[str, Any], list[Table]]:
    """Figures and a table; see ``READS``. With ``out`` it fine-tunes.

    Raises:
        OptionError: no project.
    """
    from gvtools.scenes.project import open_project

    if options.project is None:
        raise OptionError("experiment real-frames needs --project DIR, a scan with depth")
    scene = open_project(options.project)
    methods: dict[str, Completer] = {
        name: method for name, method in classical_rows().items() if name != SLOW
    }
    methods |= undenoised_rows(options.weights)
    methods["student 1+1"] = geoverse(options.weights, steps=1)
    methods["student 3+1"] = geoverse(options.weights)
    if options.out is not None:
        tuned = _tuned(options)
        methods["fine-tuned 1+1"] = geoverse(tuned, steps=1)
        methods["fine-tuned 3+1"] = geoverse(tuned)
    distance, said = perceptual()
    cases = list(_cases(scene))
    judged = judge(methods, cases, distance=distance, seed=options.seed)
    if options.pictures is not None:
        write_pictures(options.pictures, cases, geoverse(options.weights), seed=options.seed)
    fillers = [name for name in FILLERS if name != SLOW]
    found = {
        "project": options.project.name,
        "context": CONTEXT,
        "targets": TARGETS,
        "perceptual_distance": said,
        "fine_tuning_steps": options.steps if options.out is not None else None,
        "against_best_filler": records(judged, against=peers(judged, fillers)),
        "against_best_other_filler": records(judged, against=peers(judged, fillers[:-1])),
    }
    views = f"context {CONTEXT}, {len(cases)} targets {TARGETS}"
    caption = f"{options.project.name}, {views}, generated pixels"
    return found, [table(judged, caption=caption, against=peers(judged, fillers))]


def _cases(scene: Scene) -> Iterator[Case]:
    """One case a target, each with all of the context."""
    names = [view.name for view in scene]
    context = [_observed(scene[name]) for name in select(names, CONTEXT)]
    cameras = tuple(view.camera for view in context)
    targets = [scene[name] for name in select(names, TARGETS)]
    guidance = projected(
        Observation(tuple(context), cameras), concatenate([view.camera for view in targets])
    )
    for index, view in enumerate(targets):
        truth = _observed(view)
        assert truth.depth is not None
        yield Case(view.name, tuple(context), guidance[index], truth.rgb[None], truth.depth[None])


def _observed(view: View) -> ContextView:
    frame = view.load()
    if frame.depth is None:
        raise OptionError(f"view {view.name} has no depth; expected a scan with recorded depth")
    depth = np.where(np.isfinite(frame.depth) & (frame.depth > 0), frame.depth, 0)
    picture = (frame.rgb / np.float32(255)).astype(np.float32)
    return ContextView(view.name, view.camera, picture, depth.astype(np.float32))


def _tuned(options: ExperimentOptions) -> Path:
    """Weights after a fine-tuning on the context views."""
    assert options.out is not None
    assert options.project is not None
    config, folder = shipped_or_read(options.training)
    config = with_texts(
        config,
        [
            f"seed={options.seed + 1}",
            f'data.scenes=["{options.project}"]',
            f"data.scene_select={CONTEXT}",
            f"data.scene_share={SHARE}",
            f"data.scene_overlap={OVERLAP}",
            f"data.views={VIEWS}",
            f"denoiser.optimizer.steps={options.steps}",
            f"denoiser.optimizer.rate={RATE}",
            "denoiser.optimizer.ema=0.99",
        ],
    )
    with started("auto") as processes:
        stage = StageRun(
            config,
            "denoiser",
            options.out,
            processes=processes,
            model_folder=folder,
            init=options.weights or SHIPPED,
        )
        stage.train(resume=True, say=Console().line)
    return options.out / "denoiser" / "weights"
