"""Fixtures of the room of three walls: its textures, a photographer, context views, the probe."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from walls import WALLS, Float64, Take, blotches, camera_at, photograph

from gvtools.cameras import Cameras
from gvtools.evaluation.pose_probe import (
    PoseProbe,
)
from gvtools.evaluation.posed_picture import PosedPicture


@pytest.fixture(scope="module")
def textures() -> list[Float64]:
    rng = np.random.default_rng(7)
    return [blotches(rng) for _ in WALLS]


@pytest.fixture(scope="module")
def take(textures: list[Float64]) -> Take:
    def taken(camera: Cameras, claim: Cameras | None = None) -> PosedPicture:
        picture = photograph(camera, textures)
        # No depth: what a generated picture is.
        return dataclasses.replace(picture, camera=claim or camera, depth=None)

    return taken


@pytest.fixture(scope="module")
def context(textures: list[Float64]) -> list[PosedPicture]:
    cameras = [
        camera_at((0.25 * i - 0.5, 0.1 * (i % 2), 0.1 * i), turn=(3 * i - 4, 10 - 6 * i, 2 * i),
                  name=f"c{i}")
        for i in range(5)
    ]  # fmt: skip
    return [photograph(camera, textures) for camera in cameras]


@pytest.fixture(scope="module")
def probe(context: list[PosedPicture]) -> PoseProbe:
    return PoseProbe(context)
