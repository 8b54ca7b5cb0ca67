"""A recorded scan: some views are the context, views between are judged.

A model that was tuned to the same context (``gvtools train tune``) is judged beside the others.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from benchmarks.experiments.cases import Case
from benchmarks.experiments.judging import judge, peers, perceptual, records, table
from benchmarks.experiments.options import ExperimentOptions
from benchmarks.experiments.pictures import write_pictures
from benchmarks.experiments.rows import FILLERS, classical_rows, geoverse, undenoised_rows
from gvtools.cameras import concatenate
from gvtools.completers.base import Completer, ContextView
from gvtools.errors import OptionError
from gvtools.evaluation.tables import Table
from gvtools.scenes.scene import Scene, View
from gvtools.scenes.selection import select
from gvtools.training.samples import Observation, project_observation

READS = ("weights", "tuned", "project", "context", "targets", "seed", "pictures")

# scikit-image's filler takes minutes a picture of this size.
SLOW = "biharmonic"


def run(options: ExperimentOptions) -> tuple[dict[str, Any], list[Table]]:
    """Figures and a table; see ``READS``.

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
    if options.tuned is not None:
        methods["tuned 1+1"] = geoverse(options.tuned, steps=1)
        methods["tuned 3+1"] = geoverse(options.tuned)
    distance, said = perceptual()
    cases = list(_cases(scene, options.context, options.targets))
    judged = judge(methods, cases, distance=distance, seed=options.seed)
    if options.pictures is not None:
        write_pictures(options.pictures, cases, geoverse(options.weights), seed=options.seed)
    fillers = [name for name in FILLERS if name != SLOW]
    found = {
        "project": options.project.name,
        "context": options.context,
        "targets": options.targets,
        "perceptual_distance": said,
        "against_best_filler": records(judged, against=peers(judged, fillers)),
        "against_best_other_filler": records(judged, against=peers(judged, fillers[:-1])),
    }
    views = f"context {options.context}, {len(cases)} targets {options.targets}"
    caption = f"{options.project.name}, {views}, generated pixels"
    return found, [table(judged, caption=caption, against=peers(judged, fillers))]


def _cases(scene: Scene, given: str, judged: str) -> Iterator[Case]:
    """One case a target, each with all of the context."""
    names = [view.name for view in scene]
    context = [_observed(scene[name]) for name in select(names, given)]
    cameras = tuple(view.camera for view in context)
    targets = [scene[name] for name in select(names, judged)]
    guidance = project_observation(
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
