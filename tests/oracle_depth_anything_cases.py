"""Depth Anything 3 and its re-run from generated features, against the reference values."""

from __future__ import annotations

from typing import Any

import torch
from oracle_networks import Fixture, fill_, formula_input
from torch import Tensor

from gvtools.completers.geoverse.depth_anything.encoder import EncoderConfig
from gvtools.completers.geoverse.depth_anything.geometry_head import GeometryHeadConfig
from gvtools.completers.geoverse.depth_anything.network import DepthAnything3, DepthAnythingConfig

# The released sizes, for fixtures that name a model instead of giving its dimensions.
SIZES = {
    "small": (EncoderConfig(width=384, heads=6), GeometryHeadConfig(768, 64, (48, 96, 192, 384))),
    "base": (EncoderConfig(), GeometryHeadConfig()),
}


def network(fixture: Fixture) -> DepthAnything3:
    """The fixture's network with the formula's weights."""
    config = fixture.data.get("config")
    if isinstance(config, dict) and "backbone" in config:
        built = _config(config)
    else:
        said = f"{fixture.name} {config} {fixture.data.get('class_', '')}".lower()
        size = next(size for size in SIZES if size in said)
        built = DepthAnythingConfig(*SIZES[size])
    module = DepthAnything3(built).eval()
    fill_(module, fixture.salt)
    fixture.check_weights(module)
    return module


def _config(config: dict[str, Any]) -> DepthAnythingConfig:
    body, head, camera = config["backbone"], config["head"], config.get("cam_enc", {})
    patch = body.get("patch_size", 14)
    encoder = EncoderConfig(
        width=body["embed_dim"],
        depth=body["depth"],
        heads=body["num_heads"],
        mlp_ratio=body["mlp_ratio"],
        patch=patch,
        base_grid=body["img_size"] // patch,
        alternate_from=body["alt_start"],
        qk_norm_from=body["qknorm_start"],
        rotary_from=body["rope_start"],
        taps=tuple(body["out_layers"]),
    )
    return DepthAnythingConfig(
        encoder,
        GeometryHeadConfig(head["dim_in"], head["features"], tuple(head["out_channels"]), patch),
        camera_heads=camera.get("num_heads", 16),
        camera_depth=camera.get("trunk_depth", 4),
    )


@torch.no_grad()
def check_case(fixture: Fixture, module: DepthAnything3, case: int) -> None:
    """Every output of a case: with the learned camera token, posed, and re-run from level 1."""
    inputs = fixture.inputs(case)
    images = inputs["images_u8"].float() / 255
    encoder = module.encoder
    grid = encoder.grid(images.shape[-2], images.shape[-1])
    _check_pass(fixture, module, case, module.encode(images), grid, prefix="")

    short = module.encode(images, levels=2)
    again = [*short, *encoder.propagate(short[1], grid, boundary=1)]
    for index in range(4):
        fixture.check(case, f"raw_level{index}", again[index][:, :, 1:])

    if "w2c" in inputs:
        cam_from_world, K = inputs["w2c"].float(), inputs["K"].float()
        token = module.cam_enc(cam_from_world, K, (images.shape[-2], images.shape[-1]))
        fixture.check(case, "posed_cam_token", token)
        posed = module.encode(images, cam_from_world=cam_from_world, K=K)
        _check_pass(fixture, module, case, posed, grid, prefix="posed_")
    fixture.check_complete(case)


def _check_pass(
    fixture: Fixture,
    module: DepthAnything3,
    case: int,
    levels: list[Tensor],
    grid: tuple[int, int],
    *,
    prefix: str,
) -> None:
    geometry = module.geometry(levels, grid)
    found = {
        "depth": geometry.depth,
        "depth_conf": geometry.depth_confidence,
        "ray": geometry.ray,
        "ray_conf": geometry.ray_confidence,
        "pose_enc": module.cam_dec(levels[-1][:, :, 0]),
    }
    for index, level in enumerate(levels):
        found[f"raw_level{index}"] = level[:, :, 1:]
        found[f"token0_level{index}"] = level[:, :, 0]
        found[f"normed_level{index}"] = module.encoder.normed(level[:, :, 1:])
    stored = set(fixture.outputs(case))
    checked = [name for name in found if prefix + name in stored]
    assert checked, f"{fixture.name}: case {case} holds no output with the prefix {prefix!r}"
    for name in checked:
        fixture.check(case, prefix + name, found[name])


@torch.no_grad()
def check_propagation(fixture: Fixture, module: DepthAnything3, case: int) -> None:
    """Normalised level-1 latents to the levels after it (``gld_propagation``)."""
    from gvtools.completers.geoverse.statistics import LatentStatistics

    what = fixture.cases[case]
    batch, views, grid = what["B"], what["V"], tuple(what["grid"])
    stats = fixture.data["stats"]
    channels = module.config.encoder.channels
    variance = formula_input(_named(stats["latent_var"]), stats["shape"]).exp()
    statistics = LatentStatistics(channels, eps=stats["eps"])
    statistics.mean.copy_(formula_input(stats["latent_mean"], stats["shape"]).reshape(-1))
    statistics.var.copy_(variance.reshape(-1))

    latent = formula_input(what["latent_input"], (batch * views, channels, *grid))
    raw = statistics.denormalise(latent)
    fixture.check(case, "denormalised", raw)
    fixture.check(case, "renormalised_roundtrip", statistics.normalise(raw))
    token = torch.zeros(batch * views, channels)
    if what["cls_given"]:
        token = formula_input(what["cls_input"], (batch * views, channels))
    token = statistics.denormalise(token[:, :, None, None])[..., 0, 0]
    tokens = torch.cat((token[:, None], raw.flatten(2).transpose(1, 2)), dim=1)
    level = tokens.unflatten(0, (batch, views))
    levels = [level, *module.encoder.propagate(level, grid, boundary=1)]
    for index, found in enumerate(levels, start=1):
        fixture.check(case, f"patches_level{index}", module.encoder.normed(found[:, :, 1:]))
        fixture.check(case, f"token0_level{index}", found[:, :, 0])
    fixture.check_complete(case)


def _named(text: str) -> str:
    """The formula inside "exp( formula: NAME )"."""
    return text.removeprefix("exp(").removesuffix(")").strip()
