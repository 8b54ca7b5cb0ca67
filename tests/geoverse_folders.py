"""Weights folders of a micro model for the tests: published files, and one's own; how they load."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import geoverse_models as micro
import published_folder as published
import pytest
import torch
from torch import Tensor

from gvtools.completers.geoverse import GeoVerse
from gvtools.completers.geoverse.config import GeoVerseConfig
from gvtools.completers.geoverse.weights.folder import check_folder, from_pretrained
from gvtools.completers.geoverse.weights.folder_parts import PartReport
from gvtools.errors import CheckpointError

PLAIN = micro.config()
CONTROL, SHARED = micro.config(injection="control"), micro.config(injection="shared")
# What GeoVerse adds to the published networks, taken away.
BARE = replace(PLAIN, level1=replace(PLAIN.level1, depth_condition=False))


def write_source(folder: Path) -> Path:
    """A folder of published files; its config.json has neither video nor extensions."""
    return published.write_published(micro.model(BARE), folder)


def load(folder: Path, config: GeoVerseConfig | None = None) -> GeoVerse:
    """The model of a folder, without its video prior."""
    return from_pretrained(folder, config=config, video=False)


def equal(a: GeoVerse, b: GeoVerse) -> bool:
    """Whether two models hold the same tensors, types included."""
    first, second = a.state_dict(), b.state_dict()
    return first.keys() == second.keys() and all(
        torch.equal(first[n], second[n]) and first[n].dtype == second[n].dtype for n in first
    )


def output(model: GeoVerse) -> list[Tensor]:
    """What a model makes of fixed views."""
    views = micro.batch()
    features = None if model.config.video is None else micro.video_features(1, 4)
    made = model.generate(views, seed=3, video=features)
    return [made.level1, made.level0, made.decoded.rgb, made.decoded.geometry.depth]


def report(folder: Path, name: str, config: GeoVerseConfig | None = None) -> PartReport:
    """What checking a folder says of one part."""
    return next(part for part in check_folder(folder, config) if part.name == name)


def refused(folder: Path, message: str, config: GeoVerseConfig | None = None) -> str:
    """Loading and checking refuse a folder alike; the message."""
    with pytest.raises(CheckpointError, match=message) as caught:
        load(folder, config)
    said = str(caught.value)
    assert "\n" not in said
    bad = [part for part in check_folder(folder, config) if not part.ok and part.name != "video"]
    assert bad
    assert bad[0].said in said
    return said
