from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from oracle import ABSENT, ORACLE, arrays, expected_values

from gvtools.evaluation.statistics import ErrorStatistics
from gvtools.evaluation.trajectories import absolute_errors, by_index, by_time, relative_errors
from gvtools.trajectory_files import read_poses

RELATIVE = 1e-6
ABSOLUTE = 1e-9  # scene units
ANGLE = 1e-6  # degrees
# Near 0 and 180 degrees an angle is known to the root of what its cosine is known to.
FLAT_ANGLE = 1e-5

CASES = list(expected_values(ORACLE / "trajectories"))
pytestmark = [pytest.mark.data, pytest.mark.skipif(not CASES, reason=ABSENT)]


def poses_of(path: Path, name: str, case: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """The associated poses of a case: files of its own, or arrays beside the JSON."""
    if "reference" not in case:
        for stored in arrays(path):
            if f"{name}.reference" in stored:
                return stored[f"{name}.reference"], stored[f"{name}.estimate"]
        raise AssertionError(f"{path}: no arrays of {name}")
    reference = read_poses(path.parent / case["reference"], layout=case["format"])
    estimate = read_poses(path.parent / case["estimate"], layout=case["format"])
    assert len(reference) == case["n_reference"]
    assert len(estimate) == case["n_estimate"]
    if "max_time_difference_s" in case:
        assert reference.stamps is not None
        assert estimate.stamps is not None
        first, second = by_time(
            reference.stamps, estimate.stamps, max_difference=case["max_time_difference_s"]
        )
        for stored in (np.load(file) for file in path.parent.glob("*.npz")):
            if f"{name}.reference_index" in stored:
                np.testing.assert_array_equal(first, stored[f"{name}.reference_index"])
                np.testing.assert_array_equal(second, stored[f"{name}.estimate_index"])
    else:
        first, second = by_index(len(reference), len(estimate))
    return reference.poses[first], estimate.poses[second]


@pytest.fixture(scope="module")
def loaded() -> dict[tuple[Path, str], tuple[np.ndarray, np.ndarray]]:
    return {}


def agree(
    ours: ErrorStatistics | None, theirs: dict[str, float], *, relative: float, absolute: float
):
    assert ours is not None
    for key in ("rmse", "mean", "median", "max", "min", "std"):
        if key in theirs:
            assert getattr(ours, key) == pytest.approx(theirs[key], rel=relative, abs=absolute), key
    if "n_pairs" in theirs:
        assert ours.n == theirs["n_pairs"]


@pytest.mark.parametrize(
    ("path", "name", "case", "align"),
    [
        # Relative errors of thousands of poses take seconds; of one recording they are enough.
        pytest.param(
            *each, align, id=f"{each[1]}-{align}",
            marks=pytest.mark.slow if align == "none" and "fr2_desk" in each[1] else [],
        )
        for each in CASES
        for align in ("none", "se3", "sim3")
    ],
)  # fmt: skip
def test_pose_errors_are_evos(loaded, path, name, case, align):
    if align not in case:
        pytest.skip(f"{name} has no values for {align}")
    if (path, name) not in loaded:
        loaded[path, name] = poses_of(path, name, case)
    reference, estimate = loaded[path, name]
    assert len(reference) == case["n_pairs"]
    expected = case[align]
    honest = absolute_errors(reference, estimate, align=align)
    if "raises" in expected:
        # What evo refuses has a status, and a number only where no alignment is needed for it.
        assert honest.rotation_deg is None
        assert honest.status.startswith(("degenerate: ", "aligned along a line"))
        relative = relative_errors(reference, estimate, align=align)
        if align == "se3" and relative.ok:
            free = relative_errors(reference, estimate, align="none")
            assert relative.translation == free.translation
        return
    if "line" in honest.status:
        # evo lets exact lines pass by their rounding errors; the rotation about them is arbitrary.
        agree(honest.translation, expected["ate"], relative=RELATIVE, absolute=ABSOLUTE)
        return
    errors = absolute_errors(reference, estimate, align=align, refuse_mirrored=False)
    assert honest.ok or "mirror" in honest.status
    agree(errors.translation, expected["ate"], relative=RELATIVE, absolute=ABSOLUTE)
    flat = FLAT_ANGLE if errors.rotation_deg and errors.rotation_deg.min < 0.01 else ANGLE
    agree(errors.rotation_deg, expected["ape_rotation_deg"], relative=RELATIVE, absolute=flat)
    if "alignment" in expected:
        assert errors.scale == pytest.approx(expected["alignment"]["scale"], rel=RELATIVE)
    for kind, values in expected["rpe"].items():
        delta, mode = kind.removeprefix("delta").split("_", 1)
        errors = relative_errors(
            reference, estimate, align=align, delta=int(delta), all_pairs=mode == "all_pairs",
            refuse_mirrored=False,
        )  # fmt: skip
        if values is None or not values.get("translation", {}).get("n_pairs", 1):
            assert not errors.ok
            continue
        agree(errors.translation, values["translation"], relative=RELATIVE, absolute=ABSOLUTE)
        agree(errors.rotation_deg, values["rotation_deg"], relative=RELATIVE, absolute=FLAT_ANGLE)
