"""The denoisers, their guidance and whole sampling runs, against the reference values."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from oracle_networks import MATRIX, Fixture, fill_, formula_input
from torch import Tensor

from gvtools.completers.geoverse.denoiser import Conditions, Denoiser, DenoiserConfig
from gvtools.completers.geoverse.flow import (
    gld_time_grid,
    integrate,
    interpolate,
    sample,
    velocity_target,
)
from gvtools.completers.geoverse.plucker import CameraCondition, camera_condition

# The same formula through a whole sampling run adds up (README, "Tolerances").
LATENTS = 1e-4


def denoiser_config(entry: dict[str, Any]) -> DenoiserConfig:
    """Our configuration of an upstream one."""
    values = entry["params"]
    old = entry["module"] == "DDT_old"
    cascade = values.get("source_condition_mode") == "l1_as_cond"
    for option, expected in (
        ("use_qknorm", False),
        ("use_swiglu", True),
        ("use_rope", False),
        ("use_rmsnorm", True),
        ("use_pos_embed", False),
        ("use_prope", True),
        ("is_concat_mode", True),
        ("patch_size", 1),
    ):
        assert values.get(option, expected) == expected, f"no counterpart of {option}"
    return DenoiserConfig(
        channels=values["in_channels"],
        width=values["hidden_size"][0],
        depth=values["depth"][0],
        heads=values["num_heads"][0],
        head_width=values["hidden_size"][1],
        head_depth=values["depth"][1],
        head_heads=values["num_heads"][1],
        mlp_ratio=values["mlp_ratio"],
        camera_patch=values["cam_patch_size"],
        source=cascade,
        separate_embedders=not (old or values.get("architecture_mode") == "old"),
        projective_size=values["cam_input_size"] if old else None,
    )


def guidance_mode(entry: dict[str, Any]) -> str:
    """Which unconditional branch the upstream class has."""
    if entry["module"] == "DDT_old":
        return "old"
    return "new" if entry["params"].get("cfg_mode", "new") == "new" else "old_train"


def network(fixture: Fixture, name: str) -> Denoiser:
    """One of the fixture's denoisers with the formula's weights."""
    module = Denoiser(denoiser_config(fixture.data["configs"][name])).eval()
    fill_(module, fixture.salt)
    return module


@torch.no_grad()
def check_case(fixture: Fixture, case: int) -> None:
    """One forward pass and its guided version (``gld_level1``, ``gld_cascade``)."""
    what = fixture.cases[case]
    entry = fixture.data["configs"][what["model"]]
    module = network(fixture, what["model"])
    inputs = fixture.inputs(case)
    batch, views = what["B"], what["V"]
    context, size = int(inputs["cond_num"]), _size(inputs)
    rays = formula_input(what["camera_input"], (batch * views, 6, *size))
    mask = (torch.arange(views) >= context).float().repeat(batch)[:, None, None, None]
    rays = torch.cat((mask.expand(-1, 1, *size), rays), dim=1).unflatten(0, (batch, views))
    fixture.check(case, "camera", rays.flatten(0, 1), MATRIX, "in_check.")
    camera = CameraCondition(
        rays, inputs["viewmats"].float(), inputs["K"].float(), size, torch.ones(batch), context
    )
    conditions = Conditions(
        _views(inputs["ref_cond"], batch),
        camera,
        source=_views(inputs["source_condition"], batch) if "source_condition" in inputs else None,
    )
    noisy, t = _views(inputs["x_noisy"], batch), inputs["t"].float().unflatten(0, (batch, views))
    velocity = module(noisy, t, conditions)
    fixture.check(case, "velocity", velocity.flatten(0, 1))
    without = replace(conditions, camera=camera.unconditional(guidance_mode(entry)))
    base = module(noisy, t, without)
    fixture.check(case, "velocity_cfg1p5", (base + 1.5 * (velocity - base)).flatten(0, 1))
    fixture.check_complete(case)


@torch.no_grad()
def check_sampler(fixture: Fixture, case: int) -> None:
    """A whole sampling run on real cameras (``gld_sampler``)."""
    what = fixture.cases[case]
    entry = fixture.data["configs"][what["model"]]
    module = network(fixture, what["model"])
    inputs = fixture.inputs(case)
    conditions = _real_conditions(fixture, case, inputs)
    without = replace(conditions, camera=conditions.camera.unconditional(guidance_mode(entry)))
    times = gld_time_grid(int(inputs["num_steps"]), shift=float(inputs["shift"]))
    fixture.check(case, "time_grid", torch.tensor(times), 1e-6)
    states: list[Tensor] = []
    final = sample(
        lambda x, t: module(x, t, conditions),
        inputs["noise"][None],
        times,
        unconditional=lambda x, t: module(x, t, without),
        guidance=float(inputs["cfg_scale"]),
        callback=lambda step, t, x: states.append(x),
    )
    assert len(states) == what["num_model_evaluations"]
    trajectory = [inputs["noise"][None], *states]
    fixture.check(case, "latent_after_step1", trajectory[1][0], LATENTS)
    fixture.check(case, "latent_mid", trajectory[len(trajectory) // 2][0], LATENTS)
    fixture.check(case, "latent_final", final[0], LATENTS)
    if "cond_half_final_absdiff" in fixture.outputs(case):
        # The context half of upstream's state: ours is no part of the state and may not change.
        drift = (conditions.latents[0] - inputs["ref_cond"]).abs().max()
        fixture.check(case, "cond_half_final_absdiff", drift.double().reshape(1), 1e-6)
    fixture.check_complete(case)
    again = integrate(lambda x, t: torch.zeros_like(x), final, times)
    assert torch.equal(again, final)


@torch.no_grad()
def check_loss(fixture: Fixture, name: str) -> None:
    """The per-view training loss at a fixed time (``gld_sampler``, ``loss{j}``)."""
    module = network(fixture, next(iter(fixture.data["configs"])))
    inputs = fixture.inputs(name)
    conditions = _real_conditions(fixture, name, inputs)
    clean, noise = inputs["clean_x1"][None], inputs["noise_x0"][None]
    t = inputs["t"].float().reshape(1)
    predicted = module(interpolate(clean, noise, t), t, conditions)
    fixture.check(name, "pred", predicted[0])
    loss = (predicted - velocity_target(clean, noise)).square().flatten(2).mean(2)[0]
    context = int(inputs["cond_num"])
    fixture.check(name, "loss", loss)
    fixture.check(name, "ref_loss", loss[:context])
    fixture.check(name, "tgt_loss", loss[context:])
    fixture.check_complete(name)


def _real_conditions(fixture: Fixture, case: int | str, inputs: dict[str, Tensor]) -> Conditions:
    """Conditions of (V, 4, 4) cameras, their built parts checked."""
    size = _size(inputs)
    context = int(inputs["cond_num"])
    camera = camera_condition(
        inputs["c2w"].float()[None], inputs["K"].float(), size, context=context
    )
    built = {"camera": camera.map[0], "viewmats": camera.cam_from_world}
    for name, value in built.items():
        if f"{case if isinstance(case, str) else f'case{case}'}.in_check.{name}" in (
            fixture.arrays.files
        ):
            fixture.check(case, name, value, MATRIX, "in_check.")
    source = inputs.get("source_condition")
    return Conditions(
        inputs["ref_cond"][None], camera, source=None if source is None else source[None]
    )


def _size(inputs: dict[str, Tensor]) -> tuple[int, int]:
    """(H, W) of the pictures."""
    height, width = inputs["image_hw"]
    return int(height), int(width)


def _views(x: Tensor, batch: int) -> Tensor:
    """(B * V, ...) to (B, V, ...)."""
    return x.unflatten(0, (batch, -1))
