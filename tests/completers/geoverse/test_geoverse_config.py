from __future__ import annotations

import json
import re
from importlib import resources
from pathlib import Path
from typing import Any

import geoverse_models as micro
import pytest
import torch

from gvtools.completers.geoverse.config import GeoVerseConfig, named
from gvtools.errors import OptionError
from gvtools.networks.config_json import from_json, to_json
from gvtools.settings import dotted, with_file
from gvtools.training.options import TrainingSettings


def test_wrong_ranges_in_a_file_are_refused():
    data = to_json(named("tiny"))
    for part, key, value, said in (
        ("flow", "shift", 0.0, r"flow\.shift"),
        ("camera", "reference", 8, r"camera\.reference"),
        # They would be built for hours before anything is compared.
        ("level1", "depth", 10**8, "blocks of level1 100000002; expected at most 1000"),
        ("rgb", "depth", 10**8, "blocks of rgb 100000000; expected"),
    ):
        changed = {**data, part: {**data[part], key: value}}
        with pytest.raises(OptionError, match=said):
            from_json(GeoVerseConfig, changed)
    with pytest.raises(OptionError, match="needs filled hints"):
        micro.config(composition="correction")
    with pytest.raises(OptionError, match="image_size 12000000; expected at least 12 and at most"):
        from_json(GeoVerseConfig, {**data, "image_size": 12_000_000})
    with pytest.raises(OptionError, match=r"^config = .{60}; expected an object"):
        from_json(GeoVerseConfig, [data] * 1000)


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


TABLE = Path(__file__).parents[3] / "docs" / "concepts" / "hyperparameters.md"
GLD_GRID = re.compile(r"49 steps of `(gld_time_grid\(50, shift=([\d.]+)\))`")


# What the paper states in so many words, and where the table says it: (section, setting, text).
STATED: tuple[tuple[str, str, str, Any], ...] = (
    ("Model", "image_size", "504", 504),
    ("Model", "geometry.encoder.taps", "5, 7, 9, 11", [5, 7, 9, 11]),
    ("Model", "video.taps", "0, 5, 10, 15", [0, 5, 10, 15]),
    ("Model", "video.channels", "5120", 5120),
    ("Model", "video.timestep", "500", 500.0),
    ("Model", "video.proxy_noise", "0.1", 0.1),
    ("Model", "flow.most_time", "1", 1.0),
    ("Training", "data.views", "8", 8),
    ("Training", "denoiser.optimizer.steps", "300,000", 300_000),
    ("Training", "denoiser.optimizer.rate", "3e-5", 3e-5),
    ("Training", "denoiser.optimizer.clip", "1.0", 1.0),
    ("Training", "denoiser.optimizer.ema", "0.9995", 0.9995),
    ("Training", "denoiser.context_weight", "0.25", 0.25),
    ("Training", "reflow.optimizer.steps", "up to 50,000", 50_000),
    ("Training", "reflow.optimizer.rate", "1e-5", 1e-5),
)


def columns(title: str) -> dict[str, list[str]]:
    section = TABLE.read_text(encoding="utf-8").split(f"## {title}\n")[1].split("\n## ")[0]
    rows = [line.strip("| ").split(" | ") for line in section.splitlines() if line[:3] == "| `"]
    return {row[0].strip("`"): row[1:] for row in rows}


def model_values(name: str) -> dict[str, Any]:
    values = dotted(to_json(named(name)))
    return {key: value for key, value in values.items() if key not in {"name", "trained"}}


def training_values(name: str) -> dict[str, Any]:
    file = resources.files("gvtools.training").joinpath("configs", f"{name}.json")
    values = dotted(with_file(TrainingSettings(), Path(str(file))).to_dict())
    return {key: value for key, value in values.items() if key not in {"model", "seed"}}


def check(cells: dict[str, str], values: dict[str, Any]) -> None:
    assert {key for key, cell in cells.items() if cell != "-"} == set(values)
    for key, value in values.items():
        grid = GLD_GRID.fullmatch(cells[key])
        if grid:
            from gvtools.completers.geoverse.flow import gld_time_grid

            assert tuple(value) == gld_time_grid(50, shift=float(grid[2])), key
        else:
            assert json.loads(cells[key].strip("`")) == json.loads(json.dumps(value)), key


def test_the_models_are_as_documented():
    rows = columns("Model")
    for column, name in enumerate(("base", "gld", "tiny"), 2):
        check({key: cells[column] for key, cells in rows.items()}, model_values(name))


def test_what_the_paper_states_is_said_and_is_what_base_has():
    values = {"Model": model_values("base"), "Training": training_values("base")}
    for section, key, text, value in STATED:
        assert columns(section)[key][0] == text
        assert values[section][key] == value, key


def test_the_trainings_are_as_documented():
    rows = columns("Training")
    for column, name in enumerate(("base", "tiny"), 2):
        check({key: cells[column] for key, cells in rows.items()}, training_values(name))
