"""Cameras, ray poses and the RGB head against the reference values, one function a fixture.

Each takes the fixture (its JSON and arrays) and the number of a case, keeps the deviations in the
fixture, and raises AssertionError where a tensor deviates by more than the README allows.
"""

from __future__ import annotations

from typing import Any

import torch
from oracle_networks import MATRIX, NETWORK, Fixture, fill_, formula_input
from torch import Tensor

from gvtools.completers.geoverse.attention import attend
from gvtools.completers.geoverse.depth_anything.homography import candidates
from gvtools.completers.geoverse.depth_anything.rays import poses_least_squares, poses_ransac
from gvtools.completers.geoverse.plucker import (
    GLD_PIXEL_OFFSET,
    camera_condition,
    normalised_poses,
    plucker_map,
)
from gvtools.completers.geoverse.projective import Projective
from gvtools.completers.geoverse.rgb_head import RGBHead, RGBHeadConfig

TABLE = "decoder_pos_embed"
# Figures that upstream's evaluation derives from the poses; the poses are compared, and no figure
# of ours is of this kind.
POSE_FIGURES = (
    "metric_focal_rel_err",
    "metric_auc3",
    "metric_auc30",
    "metric_rra15",
    "metric_rta15",
    "metric_maa30",
    "metric_mean_rot_err",
    "metric_mean_trans_err",
    "metric_scale",
    "pair_rot_err_deg",
    "pair_trans_err_deg",
)
# Read by the check itself: the sample is handed in, the number compared as it is.
RANSAC_SAMPLE = ("ransac_sample_index", "ransac_n_candidates")


@torch.no_grad()
def check_camera(fixture: Fixture, case: int) -> None:
    """Plücker maps, pose normalisation, PRoPE matrices and attention."""
    given, config = fixture.inputs(case), fixture.cases[case]
    pose, K, size = given["c2w"], given["K"], _pair(given["image_hw"])
    stored = set(fixture.outputs(case))
    condition = camera_condition(pose, K, size, context=1)
    rebased, scale = normalised_poses(pose)
    found = {
        "plucker": condition.map[:, :, 1:],
        "camray": condition.map[:, :, 1:4],
        "pose_scale": scale[:, None, None],
        "plucker_without_normalisation": plucker_map(pose, K, size, pixel_offset=GLD_PIXEL_OFFSET),
        "prope_viewmats": condition.cam_from_world,
    }
    torch.testing.assert_close(rebased[:, -1], torch.eye(4).expand_as(rebased[:, -1]))
    if "q" in given:
        grid = (config["patches_y"], config["patches_x"])
        camera = condition.cam_from_world
        # The recorded keys and values hold K where the README says P⁻¹: see projective.py.
        prope = Projective(camera, K, size, grid, given["q"].shape[-1], invert_K=False)
        q, k = prope.query(given["q"]), prope.key(given["k"])
        v = prope.value(given["v"])
        found |= {
            "prope_P": prope.matrix,
            "prope_P_T": prope.matrix.mT,
            "prope_P_inv": prope.key_matrix,
            "prope_q_transformed": q,
            "prope_k_transformed": k,
            "prope_v_transformed": v,
            "prope_attention": prope.output(attend(q, k, v)),
            "prope_v_through_output_transform": prope.output(given["v"]),
        }
    _check_all(fixture, case, found, stored, MATRIX)


def rgb_head(fixture: Fixture) -> RGBHead:
    """The fixture's decoder with the formula's weights; the position table is the constructor's."""
    config, base = fixture.data["config"]["config"], fixture.data["config"]["base_image_size"]
    patch = config["patch_size"]
    head = RGBHead(
        RGBHeadConfig(
            in_channels=_channels(fixture),
            width=config["decoder_hidden_size"],
            depth=config["decoder_num_hidden_layers"],
            heads=config["decoder_num_attention_heads"],
            mlp=config["decoder_intermediate_size"],
            patch=patch,
            base_grid=(base[0] // patch, base[1] // patch),
            eps=config["layer_norm_eps"],
        )
    ).eval()
    fill_(head, fixture.salt, skip=(TABLE,))
    fixture.check_weights(head)
    fixture.check_key(TABLE, head.decoder_pos_embed, MATRIX)
    return head


@torch.no_grad()
def check_rgb_decoder(fixture: Fixture, case: int, head: RGBHead | None = None) -> None:
    """Logits, picture and interpolated positions."""
    config = fixture.cases[case]
    head = head or rgb_head(fixture)
    features = formula_input(config["features_input"], config["features_shape"])
    fixture.check(case, "features", features, 1e-6, prefix="in_check.")
    grid = (config["grid"][0], config["grid"][1])
    found = {
        "logits": head.logits(features, grid),
        "image": head(features, grid, chunk=1),
        "pos_embed_interpolated": head.positions(grid),
    }
    _check_all(fixture, case, found, set(fixture.outputs(case)), NETWORK)


def ray_pose_name(fixture: Fixture, case: int) -> tuple[str, str]:
    """Kind and prefix of a case: cases of a kind are numbered by themselves."""
    kind = fixture.cases[case]["kind"]
    number = sum(other["kind"] == kind for other in fixture.cases[:case])
    return kind, f"{'' if kind == 'gld' else kind}case{number}"


def check_ray_pose(fixture: Fixture, case: int) -> None:
    """Poses from rays, of the kind that the case names."""
    kind, name = ray_pose_name(fixture, case)
    given = fixture.inputs(name)
    (_check_gld if kind == "gld" else _check_da3)(fixture, name, given)


def _check_gld(fixture: Fixture, name: str, given: dict[str, Tensor]) -> None:
    found = poses_least_squares(
        given["ray"],
        given.get("ray_conf"),
        size=_pair(given["input_size"]),
        subsample=int(given["subsample"]),
    )
    fixture.check(name, "c2w", found.world_from_cam, MATRIX)
    for K in found.K:
        fixture.check(name, "K", K, MATRIX)
    fixture.check_complete(name, beside=POSE_FIGURES)


def _check_da3(fixture: Fixture, name: str, given: dict[str, Tensor]) -> None:
    ray, size = given["ray"], _pair(given["image_hw"])
    stored = torch.from_numpy(fixture.arrays[f"{name}.out.ransac_sample_index"])
    assert int(fixture.arrays[f"{name}.out.ransac_n_candidates"]) == candidates(
        ray.shape[-3] * ray.shape[-2]
    )
    by_index = poses_ransac(ray, given["ray_conf"], size=size, samples=stored)
    by_seed = poses_ransac(ray, given["ray_conf"], size=size, seed=int(given["torch_seed"]))
    torch.testing.assert_close(by_seed.world_from_cam, by_index.world_from_cam, rtol=0, atol=0)
    half = torch.tensor([size[1] / 2, size[0] / 2], dtype=by_index.K.dtype)
    pose, K = by_index.world_from_cam, by_index.K
    found = {
        "R": pose[..., :3, :3],
        "T": pose[..., :3, 3],
        "K_pixels": K,
        "focal": K.diagonal(dim1=-2, dim2=-1)[..., :2] / half,
        "principal_point": K[..., :2, 2] / half,
    }
    for key, tensor in found.items():
        fixture.check(name, key, tensor, MATRIX)
    fixture.check_complete(name, beside=RANSAC_SAMPLE)


def _check_all(
    fixture: Fixture, case: int, found: dict[str, Tensor], stored: set[str], tolerance: float
) -> None:
    unknown = stored - set(found)
    assert not unknown, f"{fixture.name}: nothing to compare {sorted(unknown)} with"
    for name in sorted(stored):
        fixture.check(case, name, found[name], tolerance)
    fixture.check_complete(case)


def _channels(fixture: Fixture) -> int:
    return fixture.cases[0]["features_shape"][-1]


def _pair(size: Any) -> tuple[int, int]:
    return int(size[0]), int(size[1])
