"""The documented table of hyper-parameters is that of the configurations, and complete."""

from __future__ import annotations

import json
import re
from importlib import resources
from pathlib import Path
from typing import Any

from gvtools.completers.geoverse.config import named
from gvtools.networks.config_json import to_json
from gvtools.settings import dotted, with_file
from gvtools.training.options import TrainingSettings

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
    """The cells of a section's table by the first one."""
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
