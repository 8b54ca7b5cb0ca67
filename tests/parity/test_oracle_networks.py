"""Networks, cameras and sampling against the reference values of the official implementations.

Driven by the fixtures' own JSON (configurations, cases, salt): any folder of the same layout, named
by GVTOOLS_ORACLE, is tried as well. Which check a fixture gets follows from its name's beginning.
"""

from __future__ import annotations

import functools
from pathlib import Path

import oracle_denoiser_cases
import oracle_depth_anything_cases
import oracle_flow_cases
import oracle_geometry_cases
import pytest
import torch
from oracle import ABSENT, ORACLE, network_fixtures, unclaimed, without_cases
from oracle_networks import Fixture

from gvtools.completers.geoverse.config import named
from gvtools.completers.geoverse.denoiser import Denoiser, DenoiserConfig
from gvtools.completers.geoverse.rgb_head import RGBHead
from gvtools.networks.depth_anything.network import DepthAnything3, DepthAnythingConfig
from gvtools.networks.tensors import shapes

FIXTURES = network_fixtures(ORACLE)
pytestmark = pytest.mark.skipif(not FIXTURES, reason=ABSENT)
# Beginnings of the names that a test below takes, and of those that it takes case by case.
CLAIMED: set[str] = set()
BY_CASE: set[str] = set()


def names(start: str) -> list[str]:
    CLAIMED.add(start)
    return [name for name in FIXTURES if name.startswith(start)]


def cases(*starts: str) -> list[tuple[str, int]]:
    """Fixture and case number of every case of the fixtures with such names."""
    BY_CASE.update(starts)
    return [
        (name, index)
        for start in starts
        for name in names(start)
        for index in range(len(FIXTURES[name].get("cases", [])))
    ]


@functools.lru_cache(maxsize=1)
def depth_anything(name: str) -> tuple[Fixture, DepthAnything3]:
    fixture = Fixture(ORACLE / name)
    return fixture, oracle_depth_anything_cases.network(fixture)


@functools.lru_cache(maxsize=1)
def fixture_of(name: str) -> Fixture:
    return Fixture(ORACLE / name)


@pytest.fixture(autouse=True)
def _free_networks(request: pytest.FixtureRequest):  # type: ignore[no-untyped-def]
    yield
    if "keys" in request.node.name:
        depth_anything.cache_clear()


@pytest.mark.parametrize(
    ("name", "case"),
    # The smaller networks have every part of the base one.
    [pytest.param(*c, marks=pytest.mark.slow) if "base" in c[0] else c for c in cases("da3_")],
)
def test_depth_anything(name: str, case: int) -> None:
    oracle_depth_anything_cases.check_case(*depth_anything(name), case)


@pytest.mark.parametrize(("name", "case"), cases("gld_propagation"))
def test_levels_propagated_from_generated_latents(name: str, case: int) -> None:
    oracle_depth_anything_cases.check_propagation(*depth_anything(name), case)


@pytest.mark.parametrize(("name", "case"), cases("gld_level1", "gld_cascade"))
def test_denoiser_and_its_guidance(name: str, case: int) -> None:
    oracle_denoiser_cases.check_case(fixture_of(name), case)


@pytest.mark.parametrize(("name", "case"), cases("gld_sampler"))
def test_whole_sampling_run(name: str, case: int) -> None:
    oracle_denoiser_cases.check_sampler(fixture_of(name), case)


def loss_names(fixture: Fixture) -> list[str]:
    """Prefixes of the training losses that a sampler's fixture stores."""
    return sorted({key.split(".")[0] for key in fixture.arrays.files if key.startswith("loss")})


@pytest.mark.parametrize("name", names("gld_sampler"))
def test_training_loss_at_a_fixed_time(name: str) -> None:
    fixture = fixture_of(name)
    losses = loss_names(fixture)
    assert losses
    for loss in losses:
        oracle_denoiser_cases.check_loss(fixture, loss)


@pytest.mark.parametrize("name", names("gld_time"))
def test_time_grids_and_path(name: str) -> None:
    fixture = fixture_of(name)
    oracle_flow_cases.check_known(fixture.arrays.files)
    oracle_flow_cases.check_shifts(fixture)
    oracle_flow_cases.check_grids(fixture)
    oracle_flow_cases.check_training_shift(fixture)
    oracle_flow_cases.check_path(fixture)


@pytest.mark.parametrize("name", names("gld_sampler"))
def test_time_grids_and_losses_of_the_sampler(name: str) -> None:
    oracle_flow_cases.check_sampler_grids(fixture_of(name))
    oracle_flow_cases.check_losses(fixture_of(name))


@pytest.mark.parametrize(("name", "case"), cases("gld_camera"))
def test_camera_maps_and_projective_encoding(name: str, case: int) -> None:
    oracle_geometry_cases.check_camera(fixture_of(name), case)


@pytest.mark.parametrize(("name", "case"), cases("gld_rgb_decoder"))
def test_rgb_head(name: str, case: int) -> None:
    oracle_geometry_cases.check_rgb_decoder(fixture_of(name), case)


@pytest.mark.parametrize(("name", "case"), cases("ray_pose"))
def test_poses_from_rays(name: str, case: int) -> None:
    oracle_geometry_cases.check_ray_pose(fixture_of(name), case)


def test_every_fixture_is_claimed_and_has_cases() -> None:
    assert unclaimed(ORACLE, CLAIMED) == []
    assert without_cases(ORACLE, BY_CASE) == []


@pytest.mark.parametrize("name", list(FIXTURES))
def test_every_stored_output_belongs_to_a_case_that_is_run(name: str) -> None:
    fixture = fixture_of(name)
    known = [f"case{index}" for index in range(len(fixture.cases))]
    if name.startswith("ray_pose"):
        numbers = range(len(fixture.cases))
        known = [oracle_geometry_cases.ray_pose_name(fixture, case)[1] for case in numbers]
    if name.startswith("gld_sampler"):
        known += loss_names(fixture)
    fixture.check_prefixes(known)


def key_list(path: Path) -> dict[str, tuple[int, ...]]:
    found = {}
    for line in path.read_text(encoding="utf-8").splitlines():
        name, shape = line.split("\t")[:2]
        found[name] = tuple(int(side) for side in shape.strip("()").split(",") if side.strip())
    return found


def small() -> DepthAnythingConfig:
    return DepthAnythingConfig(*oracle_depth_anything_cases.SIZES["small"])


@pytest.mark.parametrize(
    ("name", "prefix", "build"),
    [
        ("da3_small", "model.", lambda: DepthAnything3(small())),
        ("da3_base", "model.", lambda: DepthAnything3(named("base").geometry)),
        ("gld_da3_level1", "", lambda: Denoiser(DenoiserConfig())),
        ("gld_da3_cascade", "", lambda: Denoiser(named("base").cascade or DenoiserConfig())),
        ("gld_rgb_decoder", "", lambda: RGBHead(named("base").rgb)),
    ],
)
def test_keys_and_shapes_of_the_published_files(name: str, prefix: str, build) -> None:  # type: ignore[no-untyped-def]
    path = ORACLE / "keys" / f"{name}.txt"
    if not path.is_file():
        pytest.skip(f"no key list {path}")
    with torch.device("meta"):
        module = build()
    found = {prefix + key: shape for key, shape in shapes(module.state_dict()).items()}
    assert found == key_list(path)
