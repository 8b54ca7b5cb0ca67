"""Gaussians of blocks joined: the picture of the undivided set is the reference."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gvtools.appearance.appearance import Appearance
from gvtools.appearance.exposures import Exposures
from gvtools.appearance.gaussians import Gaussians
from gvtools.appearance.splat.project_kernels import HARMONICS, LOG_SCALE, SH
from gvtools.appearance.turning import turned
from gvtools.cameras import Cameras
from gvtools.memory.store.local_frame import LocalFrame
from pipelines.blocks.appearance import BlockAppearance, join_appearances
from pipelines.blocks.block import BlockCell, SceneBlock

NAMES = ("a", "b", "c")


def camera() -> Cameras:
    K = np.array([[[40.0, 0, 24], [0, 40, 18], [0, 0, 1]]])
    return Cameras(K, np.eye(4)[None], np.array([48]), np.array([36]), ("target",))


def whole() -> Gaussians:
    rng = np.random.default_rng(2)
    positions = np.column_stack([rng.uniform(-1, 1, (300, 2)), rng.uniform(2, 3, 300)])
    some = Gaussians.at(positions, rng.uniform(40, 200, (300, 3)), sizes=np.full(300, 0.1))
    some.values[:, SH + 3 :] = rng.normal(scale=0.03, size=(300, some.values.shape[1] - SH - 3))
    return some


def in_frame(some: Gaussians, frame: LocalFrame, gain: float) -> Gaussians:
    """The same Gaussians as a block has them: in its frame, brighter by a factor."""
    values = turned(some.values, frame.axes.T)
    values[:, :LOG_SCALE] = frame.from_world(some.values[:, :LOG_SCALE])
    sh = values[:, SH:].reshape(len(values), -1, 3) * gain
    sh[:, 0] += 0.5 * (gain - 1) / HARMONICS[0]
    values[:, SH:] = sh.reshape(len(values), -1)
    return Gaussians(values, frame=frame)


def part(number: int, cell: BlockCell, *, gain: float) -> BlockAppearance:
    """A block that has all Gaussians; its photographs are darker by what they are brighter."""
    turn = Rotation.from_euler("xyz", [0.3 * number, 0.5, -0.2 * number]).as_matrix()
    frame = LocalFrame.at([number, -0.5, 0.25], turn)
    poses = np.tile(np.eye(4), (3, 1, 1))
    logs = np.full((3, 3), -np.log(gain))
    owners = NAMES[:1] if number == 0 else NAMES[1:]
    block = SceneBlock(
        str(number), ("0", "1"), "", {}, cell, owners, (), (), {}, refined=False
    )  # fmt: skip
    exposures = Exposures(frame.cam_from_local(poses), logs, 1.0)
    return BlockAppearance(
        block, NAMES, Appearance(in_frame(whole(), frame, gain), 0.1, exposures=exposures)
    )


def test_joined_blocks_show_the_undivided_picture() -> None:
    left, right = BlockCell.everywhere().cut(0, 0.1)
    merged = join_appearances([part(0, left, gain=1.25), part(1, right, gain=0.8)], LocalFrame.at())
    # Equal photographs: half of the ratio of the blocks' scales goes to each.
    assert len(merged.gaussians) == 300
    assert merged.exposures is not None
    assert np.ptp(merged.exposures.log_gains, axis=0) == pytest.approx(0, abs=1e-9)
    expected = Appearance(whole(), 0.1).picture(camera()).rgb
    found = merged.picture(camera()).rgb
    assert np.abs(found - expected).max() < 2e-3


def test_only_the_gaussians_of_the_own_cell_stay() -> None:
    left, right = BlockCell.everywhere().cut(0, 0.1)
    merged = join_appearances([part(0, left, gain=1.0), part(1, right, gain=1.0)], LocalFrame.at())
    x = np.sort(merged.gaussians.values[:, 0])
    assert np.allclose(x, np.sort(whole().values[:, 0]), atol=1e-5)
    nothing = BlockCell(np.full(3, 50.0), np.full(3, 60.0))
    parts = [part(0, left, gain=1.0), part(1, nothing, gain=1.0)]
    assert len(join_appearances(parts, LocalFrame.at()).gaussians) < 300
    with_one = join_appearances([part(0, left, gain=1.0)], LocalFrame.at())
    assert (with_one.gaussians.values[:, 0] < 0.1 + 1e-5).all()
