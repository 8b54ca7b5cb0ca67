"""ATE, RPE and pose AUC: what is known by construction, and what must stay without a number."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from walks import disturbed, line, moved, path

from gvtools.errors import DegenerateError, OptionError, ShapeError
from gvtools.evaluation.trajectories import (
    absolute_errors,
    area_under_recall,
    by_index,
    by_name,
    by_time,
    pose_auc,
    relative_errors,
)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 1000), st.floats(0.01, 100))
def test_another_frame_and_unit_are_no_error(seed, scale):
    reference = path()
    estimate = moved(reference, scale=scale, seed=seed)
    absolute = absolute_errors(reference, estimate)
    relative = relative_errors(reference, estimate)
    assert absolute.translation.max < 1e-9
    assert absolute.rotation_deg.max < 1e-5
    assert relative.translation.max < 1e-9
    assert absolute.scale == pytest.approx(1 / scale)
    assert pose_auc(reference, estimate).auc[3.0] == pytest.approx(1, abs=1e-3)


def test_a_shift_is_an_absolute_error_and_no_relative_one():
    reference = path()
    estimate = reference.copy()
    estimate[:, 0, 3] += 0.25
    absolute = absolute_errors(reference, estimate, align="none")
    relative = relative_errors(reference, estimate, align="none")
    assert absolute.status == "not aligned"
    assert absolute.translation.mean == pytest.approx(0.25)
    assert absolute.translation.std == pytest.approx(0, abs=1e-12)
    assert relative.translation.max < 1e-12
    assert absolute_errors(reference, estimate, align="se3").translation_errors.max() < 1e-12


def test_millimetres_at_a_million_metres_are_kept():
    reference = path()
    estimate = disturbed(reference, metres=1e-3)
    near = absolute_errors(reference, estimate)
    far = [poses.copy() for poses in (reference, estimate)]
    for poses in far:
        poses[:, :3, 3] += (4e6, 5e5, 100)
    there = absolute_errors(*far)
    assert there.translation.rmse == pytest.approx(near.translation.rmse, rel=1e-6)


@pytest.mark.parametrize(
    ("reference", "reason"),
    [
        (path()[:2], "at least 3"),
        (np.tile(np.eye(4), (9, 1, 1)), "coincident"),
        (path()[:0], "no poses"),
    ],
)
def test_what_determines_no_alignment_has_no_number(reference, reason):
    for errors in (absolute_errors(reference, reference), relative_errors(reference, reference)):
        assert errors.status.startswith("degenerate: ")
        assert reason in errors.status
        assert errors.translation is None
        assert errors.translation_share is None
        assert errors.rotation_deg is None
        assert errors.scale is None
        assert not errors.ok


def test_a_straight_line_has_the_figures_that_it_determines():
    reference, turn = line(), Rotation.from_euler("z", 40, degrees=True).as_matrix()
    estimate = moved(reference, scale=2)
    estimate[:, :3, :3] = estimate[:, :3, :3] @ turn
    absolute = absolute_errors(reference, estimate)
    assert absolute.status == "aligned along a line"
    assert absolute.scale == pytest.approx(0.5)
    assert absolute.translation.max < 1e-12
    assert absolute.rotation_deg is None
    bent = disturbed(estimate, metres=0.2)
    free = absolute_errors(reference, bent)
    assert absolute_errors(reference, moved(bent, seed=5)).translation.rmse == pytest.approx(
        free.translation.rmse, rel=1e-9
    )
    assert relative_errors(reference, moved(reference, scale=2)).translation.max < 1e-12
    # Motions need no alignment but for the scale.
    assert relative_errors(reference[:2], reference[:2], align="se3").translation.n == 1


def test_a_mirrored_path_is_refused_unless_asked_for():
    reference = path()
    mirrored = reference.copy()
    mirrored[:, 0, 3] *= -1
    assert "mirror" in absolute_errors(reference, mirrored).status
    forced = absolute_errors(reference, mirrored, refuse_mirrored=False)
    assert forced.translation.rmse > 0.1
    # A planar path is its own mirror image but for a turn.
    flat = reference.copy()
    flat[:, 2, 3] = 0
    turned = flat.copy()
    turned[:, 0, 3] *= -1
    assert absolute_errors(flat, turned).ok
    # Noise alone makes no mirror image.
    assert absolute_errors(flat, disturbed(flat, metres=0.01)).ok


def test_pairs_start_at_every_frame_or_where_the_last_one_ended():
    reference = path(21)
    for delta, every, apart in ((1, 20, 20), (5, 16, 4), (20, 1, 1)):
        for all_pairs, count in ((True, every), (False, apart)):
            errors = relative_errors(
                reference, disturbed(reference, metres=0.1), delta=delta, all_pairs=all_pairs
            )
            assert errors.translation.n == count
    assert "21 frames apart" in relative_errors(reference, reference, delta=21).status
    with pytest.raises(OptionError, match="1 frame"):
        relative_errors(reference, reference, delta=0)


def test_auc_of_known_errors():
    assert area_under_recall([0.0] * 4, 10.0) == pytest.approx(1, abs=1e-3)
    assert area_under_recall([5.0] * 4, 10.0) == pytest.approx(0.5, abs=1e-3)
    assert area_under_recall([5.0, 50.0], 10.0) == pytest.approx(0.25, abs=1e-3)
    assert area_under_recall([50.0], 10.0) == 0


def test_auc_of_cameras_that_stand_still_counts_their_rotation():
    poses = np.tile(np.eye(4), (3, 1, 1))
    turned = poses.copy()
    turned[1, :3, :3] = Rotation.from_euler("z", 4, degrees=True).as_matrix()
    auc = pose_auc(poses, turned)
    assert auc.still == 3
    assert auc.median_direction_deg is None
    assert auc.auc[3.0] == pytest.approx(1 / 3, abs=1e-3)
    assert pose_auc(poses[:1], poses[:1]).auc == dict.fromkeys((3.0, 5.0, 10.0, 30.0))


def test_wrong_shapes_and_values_are_refused():
    with pytest.raises(ShapeError, match="both"):
        absolute_errors(path(5), path(6))
    broken = path(5)
    broken[2, 0, 3] = np.nan
    with pytest.raises(ShapeError, match="NaN"):
        relative_errors(path(5), broken)
    with pytest.raises(OptionError, match="sim3"):
        absolute_errors(path(5), path(5), align="affine")


def test_times_are_paired_with_the_nearest():
    reference = np.arange(0, 10, 0.1)
    estimate = np.array([0.004, 1.0, 5.06, 9.9])
    first, second = by_time(reference, estimate)
    assert first.tolist() == [0, 10, 99]
    assert second.tolist() == [0, 1, 3]
    first, second = by_time(estimate, reference)
    assert (first.tolist(), second.tolist()) == ([0, 1, 3], [0, 10, 99])
    first, _ = by_time(reference, estimate - 100, offset=100, max_difference=1)
    assert len(first) == 4
    with pytest.raises(DegenerateError, match="offset, if clocks differ"):
        by_time(reference, estimate + 1000)
    with pytest.raises(DegenerateError, match="greater largest difference"):
        by_time(reference[::10], estimate[:1] + 0.4)
    # However large the difference may be, each time is used once.
    assert len(by_time(reference, estimate + 1000, max_difference=1e18)[0]) == 1
    with pytest.raises(DegenerateError, match="without poses"):
        by_time(reference, [])


def test_names_are_paired_whole_or_without_folder_and_suffix():
    first, second = by_name(["a/1.jpg", "a/2.jpg", "a/3.jpg"], ["a/3.jpg", "a/1.jpg"])
    assert (first.tolist(), second.tolist()) == ([0, 2], [1, 0])
    first, second = by_name(["images/0001.jpg", "images/0002.jpg"], ["0002.png"])
    assert (first.tolist(), second.tolist()) == ([1], [0])
    for one, other in (("a", "b"), ("1403.25.png", "1403.65.png"), ("left/1.png", "right/1.png")):
        with pytest.raises(DegenerateError, match="none of 1 and 1"):
            by_name([one], [other])
    with pytest.raises(DegenerateError, match=r"'left/1\.jpg' and 'right/1\.jpg' are one"):
        by_name(["left/1.jpg", "right/1.jpg"], ["1.png"])
    with pytest.raises(DegenerateError, match=r"'1\.jpg' occurs twice"):
        by_name(["1.jpg", "1.jpg"], ["1.png"])


def test_rows_are_paired_where_there_are_as_many():
    assert by_index(3, 3)[0].tolist() == [0, 1, 2]
    with pytest.raises(DegenerateError, match="3 and 4"):
        by_index(3, 4)
