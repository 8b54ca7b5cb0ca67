"""The specs of public data sets: complete, findable, and as the paper counts."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from gvtools.errors import OptionError
from gvtools.scenes.data_sets.catalogue import (
    DataSetSpec,
    load_spec,
    parse_spec,
    spec_names,
)

FOLDER = Path(__file__).parents[3] / "data_specs" / "data_sets"
# Scenes and images of the paper's table of training data, in its order.
TRAINING = {
    "Aria Digital Twin": (188, 232_115),
    "ARKitScenes": (644, 125_134),
    "DL3DV": (10_475, 3_594_809),
    "MapFree": (460, 515_113),
    "ScanNet++ v2": (954, 1_032_198),
    "Waymo": (3_990, 790_405),
    "RealEstate10K": (66_033, 8_832_823),
    "GTA-SfM": (200, 17_649),
    "Hypersim": (107, 17_348),
    "MVSSynth": (120, 12_000),
    "OmniWorld": (4_486, 794_596),
    "TartanAir": (18, 613_274),
    "TartanAir v2": (74, 7_135_955),
    "Virtual KITTI": (100, 42_520),
    "Spring": (37, 5_000),
}
BENCHMARKS = {
    *("RealEstate10K", "DL3DV", "Mip-NeRF 360", "ScanNetV2"),
    *("LLFF", "DTU", "Tanks and Temples", "7-Scenes", "ETH3D"),
}


@pytest.fixture(scope="module")
def specs() -> dict[str, DataSetSpec]:
    """All of them by printed name."""
    return {load_spec(name).name: load_spec(name) for name in spec_names()}


def test_the_training_sets_have_the_papers_counts(specs: dict[str, DataSetSpec]) -> None:
    training = {name: spec for name, spec in specs.items() if "training" in spec.roles}
    counted = {name: (x.counts.scenes, x.counts.images) for name, x in training.items()}
    assert counted == TRAINING
    # The paper's own totals.
    assert sum(scenes for scenes, _ in TRAINING.values()) == 87_886
    assert sum(images for _, images in TRAINING.values()) == 23_760_939


def test_the_benchmarks_are_there(specs: dict[str, DataSetSpec]) -> None:
    assert {name for name, spec in specs.items() if "benchmark" in spec.roles} == BENCHMARKS
    assert len(specs) == 22


def test_geometry_is_the_papers_rule(specs: dict[str, DataSetSpec]) -> None:
    for name, spec in specs.items():
        if spec.geometry is None:
            assert spec.roles == ("benchmark",), name
        elif name in ("RealEstate10K", "Waymo"):
            assert (spec.geometry.source, spec.geometry.own_share) == ("estimated", 0), name
        else:
            assert (spec.geometry.source, spec.geometry.own_share) == ("mixed", 2 / 3), name


def test_a_wrong_spec_is_named() -> None:
    good = yaml.safe_load((FOLDER / "spring.yaml").read_text(encoding="utf-8"))
    wrong = {
        "camera.pose": {**good, "camera": {**good["camera"], "pose": "cam2world"}},
        "depth.unit_cm": {**good, "depth": {**good["depth"], "unit_cm": 1}},
        "licence": {key: value for key, value in good.items() if key != "licence"},
    }
    for place, content in wrong.items():
        with pytest.raises(OptionError, match=place):
            parse_spec(yaml.safe_dump(content), where="spring.yaml")


def test_an_unknown_name_has_a_hint() -> None:
    with pytest.raises(OptionError, match="did you mean 'scannetppv2'"):
        load_spec("ScanNet++")
