"""A run's generative core, tuned to its context after round 0, when all of its depth is known."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gvtools.completers.base import Completer, create
from gvtools.errors import OptionError
from gvtools.runs.layout import TUNED
from gvtools.scenes.scene import Frame, Scene
from gvtools.training.tune_options import FEWEST_VIEWS

if TYPE_CHECKING:
    from gvtools.runs.folder import RunDirectory
    from pipelines.console import Console
    from pipelines.reconstruction.depth_cache import DepthCache
    from pipelines.reconstruction.plan import Plan

# In run.json: what the tuning came to.
TUNING = "tuning"


def check_tuning(completer: Completer, context: Sequence[str]) -> None:
    """Whether a completer can be tuned to so many context views."""
    from gvtools.training.tune import check_tunable

    if completer.weights is None:
        raise OptionError(
            f"tune: completer {completer.name} has no weights to tune; expected geoverse; add "
            "--completer geoverse, or leave --tune out"
        )
    check_tunable(completer.weights)
    if len(context) < FEWEST_VIEWS:
        raise OptionError(
            f"tune: {len(context)} context view(s); expected at least {FEWEST_VIEWS}, of which one "
            "judges; give more --context, or leave --tune out"
        )


def tuned(plan: Plan, cache: DepthCache, directory: RunDirectory, *, console: Console) -> Plan:
    """The plan with weights tuned to its context, now or by the attempt that is resumed.

    Args:
        plan: of the run, with its poses; its completer has weights.
        cache: gives the context's depth.
        directory: of the run; the weights are kept in it.
        console: where progress goes.
    """
    from gvtools.training.tune import tune, tuned_before

    weights, config = plan.completer.weights, plan.config
    assert weights is not None
    scene = with_depth(plan.evidence or plan.scene, plan.context, cache)
    out, options = directory.path / TUNED, {**config.completer_options}
    options.pop("weights", None)
    record = tuned_before(scene, weights, out, options=config.tune, seed=config.seed)
    if record is None:
        console.line(f"tuning {weights} to the context, {config.tune.length}")
        tuning = tune(
            scene,
            weights,
            out,
            options=config.tune,
            completer=options,
            seed=config.seed,
            say=console.line,
        )
        record = tuning.to_dict()
    else:
        console.line(f"weights tuned before: {out}")
    directory.add_to_record(TUNING, {name: record[name] for name in record if name != "inputs"})
    return replace(plan, completer=_with_weights(plan, options, out))


def with_depth(scene: Scene, names: Sequence[str], cache: DepthCache) -> Scene:
    """The context alone, its views with the depth that a run gives them."""

    def loader(name: str) -> Callable[[], Frame]:
        def load() -> Frame:
            frame = scene[name].load()
            return replace(frame, depth=cache.depth(scene[name], frame).depth)

        return load

    views = [
        replace(scene[name], load=loader(name), has_depth=cache.covers(scene[name]))
        for name in names
    ]
    return replace(scene, views=tuple(views), points=None)


def _with_weights(plan: Plan, options: dict[str, Any], folder: Path) -> Completer:
    completer = create(plan.config.completer, **options, weights=str(folder))
    return plan.config.effort.applied(completer)
