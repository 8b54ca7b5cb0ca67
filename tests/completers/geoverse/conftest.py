"""Weights that the tests of the generative core share."""

from __future__ import annotations

from pathlib import Path

import geoverse_models as micro
import pytest


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Encodes with known cameras and fills holes, as ``tiny`` does."""
    hints = {"cameras": True, "fill": "push-pull", "mask": 0.0}
    return micro.weights_folder(tmp_path_factory.mktemp("micro"), micro.config(hints=hints))
