"""Values that a configuration refuses, and the one that changes nothing but the memory."""

from __future__ import annotations

import json
from importlib import resources

import geoverse_models as micro
import pytest
import torch

from gvtools.completers.geoverse.config import CameraConfig, FlowConfig, GeoVerseConfig, named
from gvtools.errors import OptionError
from gvtools.networks.config_json import from_json, to_json


@pytest.mark.parametrize(
    ("field", "refused", "taken", "said"),
    [
        ("shift", (0.0, -3.0, float("nan")), (1.0,), "more than 0"),
        ("least_time", (0.0, -0.1, 1.5, float("nan")), (1.0,), "more than 0 and at most 1"),
        ("cfg_scale", (-1.0,), (0.0,), "at least 0"),
        ("temperature", (-0.1,), (0.0,), "at least 0"),
    ],
)
def test_flow_settings_outside_their_range_are_refused(field, refused, taken, said):
    for value in refused:
        with pytest.raises(OptionError, match=rf"flow\.{field} .*{said}"):
            FlowConfig(**{field: value})
    for value in taken:
        assert getattr(FlowConfig(**{field: value}), field) == value


@pytest.mark.parametrize(
    ("field", "refused", "taken", "said"),
    [
        ("camera.reference", (-6, 5), (-5, 0, 4), "at least -5 and at most 4"),
        ("decode_views", (0, -1), (1,), "at least 1"),
    ],
)
def test_settings_of_a_pass_outside_their_range_are_refused(field, refused, taken, said):
    def built(value: int) -> GeoVerseConfig:
        camera = field == "camera.reference"
        return micro.config(
            views=5,
            camera=CameraConfig(reference=value if camera else -1),
            decode_views=2 if camera else value,
        )

    for value in refused:
        with pytest.raises(OptionError, match=rf"{field} .*{said}"):
            built(value)
    for value in taken:
        built(value)


def test_wrong_ranges_in_a_file_are_refused():
    data = to_json(named("tiny"))
    for part, key, value in (("flow", "shift", 0.0), ("camera", "reference", 8)):
        changed = {**data, part: {**data[part], key: value}}
        with pytest.raises(OptionError, match=rf"{part}\.{key}"):
            from_json(GeoVerseConfig, changed)


@pytest.mark.parametrize("name", ["base", "tiny"])
def test_the_files_say_how_many_views_are_decoded_at_once(name):
    folder = resources.files("gvtools.completers.geoverse") / "configs"
    stored = json.loads((folder / f"{name}.json").read_text(encoding="utf-8"))
    assert stored["decode_views"] == named(name).decode_views == 8


@pytest.mark.usefixtures("one_thread")
def test_views_decoded_at_once_change_the_memory_alone(monkeypatch):
    batch = micro.batch(2, context=2, targets=3)
    whole = micro.model(micro.config(decode_views=100)).generate(batch).decoded
    model = micro.model(micro.config(decode_views=2))
    sizes: dict[str, list[int]] = {"geometry": [], "rgb": []}
    pyramid, views = model.geometry.head._pyramid, model.rgb_head._views

    def geometry_chunk(levels, *where):
        sizes["geometry"].append(len(levels[0]))
        return pyramid(levels, *where)

    def rgb_chunk(features, position):
        sizes["rgb"].append(len(features))
        return views(features, position)

    monkeypatch.setattr(model.geometry.head, "_pyramid", geometry_chunk)
    monkeypatch.setattr(model.rgb_head, "_views", rgb_chunk)
    parts = model.generate(batch).decoded
    assert sizes == {"geometry": [2] * 5, "rgb": [2] * 3}
    torch.testing.assert_close(parts.rgb, whole.rgb, rtol=1e-4, atol=1e-5)
    for name in ("depth", "depth_confidence", "ray", "ray_confidence"):
        found, expected = getattr(parts.geometry, name), getattr(whole.geometry, name)
        torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5)
