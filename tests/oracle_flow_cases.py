"""Time grids, the probability path and the latent loss of GLD, against the reference values.

Values, shifts, sizes and the sampled interval come from the fixtures.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable

import numpy as np
import torch
from oracle_networks import NETWORK, Fixture, relative_deviation

from gvtools.completers.geoverse.flow import (
    GLD_END,
    gld_time_grid,
    interpolate,
    latent_shift,
    shift_time,
    time_grid,
    unshift_time,
    velocity_target,
)
from gvtools.completers.geoverse.objective.losses import flow_matching_loss, view_errors

TIME = 1e-6


# Every array of ``gld_time``.
TIME_ARRAYS = (
    r"grid\.s\d+\.N\d+",
    r"train_shift\.s\d+\.t_(uniform|shifted)",
    r"path\.(t|noise_x0|clean_x1|x_t|target_velocity)",
)


def check_known(names: Iterable[str]) -> None:
    """Whether the checks below read every array of ``gld_time``.

    Raises:
        AssertionError: an array of another name.
    """
    known = re.compile("|".join(TIME_ARRAYS))
    if unknown := sorted(name for name in names if not known.fullmatch(name)):
        raise AssertionError(f"time grids: nothing to compare {unknown} with")


def check_shifts(fixture: Fixture) -> float:
    """Shifts that a fixture names by their formula, "...sqrt(C*h*w*V/base)"."""
    gaps = [0.0]
    for name, value in fixture.data["shifts"].items():
        if found := re.search(r"sqrt\(([\d*]+)/(\d+)\)", name):
            values = math.prod(int(factor) for factor in found[1].split("*"))
            gaps.append(abs(latent_shift(values, base=int(found[2])) - value) / value)
    return _within("latent_shift", gaps, 1e-12)


def check_grids(fixture: Fixture) -> float:
    """Every stored grid of ``gld_time``."""
    begin, most = fixture.data["sample_interval"]
    shifts = list(fixture.data["shifts"].values())
    gaps = []
    for key in fixture.arrays.files:
        if found := re.fullmatch(r"grid\.s(\d+)\.N(\d+)", key):
            shift, points = shifts[int(found[1])], int(found[2])
            ours = time_grid(
                points - 1,
                shift=shift,
                start=shift_time(1.0 - begin, shift),
                end=shift_time(1.0 - most, shift),
            )
            gaps.append(_gap(ours, fixture.arrays[key]))
            if begin == 0 and math.isclose(1 - most, GLD_END):
                gaps.append(_gap(gld_time_grid(points, shift=shift), fixture.arrays[key]))
    return _within("grids", gaps, TIME)


def check_training_shift(fixture: Fixture) -> float:
    """The shift of training times, and back."""
    shifts = list(fixture.data["shifts"].values())
    gaps = []
    for key in fixture.arrays.files:
        if found := re.fullmatch(r"train_shift\.s(\d+)\.t_uniform", key):
            shift = shifts[int(found[1])]
            uniform = torch.from_numpy(fixture.arrays[key])
            shifted = fixture.arrays[key.replace("uniform", "shifted")]
            gaps.append(_gap(shift_time(uniform, shift), shifted))
            gaps.append(
                _gap(unshift_time(torch.from_numpy(shifted).double(), shift), uniform, 1e-5)
            )
    return _within("training shift", gaps, TIME)


def check_path(fixture: Fixture) -> float:
    """x_t and the velocity target of ``gld_time``; its x0 is the noise, its x1 the clean state."""
    values = {
        name: torch.from_numpy(fixture.arrays[f"path.{name}"])
        for name in ("t", "noise_x0", "clean_x1")
    }
    clean, noise = values["clean_x1"], values["noise_x0"]
    return max(
        fixture.check_key("path.x_t", interpolate(clean, noise, values["t"]), TIME),
        fixture.check_key("path.target_velocity", velocity_target(clean, noise), TIME),
    )


def check_sampler_grids(fixture: Fixture) -> float:
    """The time grid of every case of ``gld_sampler``."""
    gaps = []
    for case, spec in enumerate(fixture.cases):
        given = fixture.inputs(case)
        points, shift = int(given["num_steps"]), float(given["shift"])
        grid = gld_time_grid(points, shift=shift)
        if len(grid) - 1 != spec.get("num_model_evaluations", points - 1):
            raise AssertionError(f"case {case}: {len(grid) - 1} evaluations")
        gaps.append(_gap(grid, fixture.arrays[f"case{case}.out.time_grid"]))
    return _within("sampler grids", gaps, TIME)


def check_losses(fixture: Fixture) -> float:
    """The per-view loss of every prediction that ``gld_sampler`` stores whole."""
    gaps = []
    for key in fixture.arrays.files:
        found = re.fullmatch(r"(loss\d+)\.out\.pred", key)
        if found and fixture.data["tensors"][key]["stored"] == "full":
            given = fixture.inputs(found[1])
            predicted = torch.from_numpy(fixture.arrays[key])[None]
            target = velocity_target(given["clean_x1"], given["noise_x0"])[None]
            context = int(given["cond_num"])
            errors = view_errors(predicted, target)[0].numpy()
            stored = {
                name: fixture.arrays[f"{found[1]}.out.{name}"]
                for name in ("loss", "ref_loss", "tgt_loss")
            }
            gaps.append(relative_deviation(errors, stored["loss"]))
            gaps.append(relative_deviation(errors[:context], stored["ref_loss"]))
            gaps.append(relative_deviation(errors[context:], stored["tgt_loss"]))
            mean = flow_matching_loss(predicted, target, context=context, context_weight=1.0)
            gaps.append(relative_deviation(mean.numpy(), stored["loss"].mean(keepdims=True)))
    return _within("latent loss", gaps, NETWORK)


def _gap(found, expected, scale: float = TIME) -> float:
    """Largest absolute difference; a looser ``scale`` than TIME is brought to it."""
    expected = np.asarray(expected, np.float64)
    found = np.asarray(found, np.float64)
    if found.shape != expected.shape:
        raise AssertionError(f"{found.shape} values, expected {expected.shape}")
    return float(np.abs(found - expected).max(initial=0)) * TIME / scale


def _within(name: str, gaps: list[float], tolerance: float) -> float:
    if not gaps:
        raise AssertionError(f"{name}: the fixture holds none")
    worst = max(gaps)
    if not worst <= tolerance:
        raise AssertionError(f"{name} deviate by {worst:.3g}, more than {tolerance:g}")
    return worst
