"""Photographs of one room, for all captures of photographs."""

from __future__ import annotations

import numpy as np
import pytest
from walls import write_project

from gvtools.scenes.project import open_project
from gvtools.similarity import fit_similarity


@pytest.fixture(scope="session")
def room(wall_walk, tmp_path_factory):
    """The project of ten photographs with true cameras; not to be changed."""
    return write_project(tmp_path_factory.mktemp("capture") / "room", wall_walk).parent


@pytest.fixture(scope="session")
def centre_error(room):
    """Largest error of the room's centres after a similarity, as a share of their extent."""
    true = open_project(room)

    def error(names, centers):
        truth = np.concatenate([true[name].camera.centers for name in names])
        return fit_similarity(centers, truth).residuals.max() / np.ptp(truth, axis=0).max()

    return error
