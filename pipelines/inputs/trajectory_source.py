"""The trajectory that a command is given: a file, a COLMAP model, a project, or a run."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import invert_rigid
from gvtools.errors import DegenerateError, OptionError, ProjectError
from gvtools.evaluation import trajectories
from gvtools.evaluation.trajectories import Rows, absolute_errors, by_index, by_name, by_time
from gvtools.scenes.colmap_model import find_model, load_model
from gvtools.scenes.layout import holds_views, is_address
from gvtools.scenes.matching import times_in
from gvtools.scenes.scene import natural_key
from gvtools.trajectory_files import Trajectory, in_time, read_poses

Float64 = NDArray[np.float64]
# Rows of two lists of times that belong together.
Match = Callable[[Float64, Float64], tuple[Rows, Rows]]
# Share of the time between poses from which pairs that differ by it may be of other moments.
FAR = 0.25
# Of poses in the time that both cover, the share that has to find a partner unless it is said; and
# rates of clocks that are tried beside those of the whole spans and of the steps.
PARTNERS, RATES = 0.5, (0.5, 2 / 3, 5 / 6, 6 / 5, 3 / 2, 2.0)


def open_trajectory(path: Path, *, layout: str = "auto", root: Path | None = None) -> Trajectory:
    """Camera-to-world poses: in the order of their times where all have one, else of their names.

    ``path`` is a TUM, KITTI or EuRoC file (of a ``layout``), a COLMAP model or workspace (its
    pictures need not be there), a transforms.json or posed RGB-D folder, spec:NAME:SCENE (below
    ``root``), or a run, whose poses are those of the views in its memory.
    """
    track = _opened(path, layout, root)
    if not track.names:
        return in_time(track)
    stamps = times_in(track.names)
    if stamps is not None:
        return in_time(Trajectory(track.poses, track.names, stamps))
    order = sorted(range(len(track)), key=lambda row: natural_key(track.names[row]))
    return Trajectory(track.poses[order], tuple(track.names[row] for row in order))


def _opened(path: Path, layout: str, root: Path | None) -> Trajectory:
    """The poses as they stand in a file or project."""
    if is_address(path):
        from gvtools.scenes.data_sets.catalogue import open_address

        scene = open_address(path, root)
        return Trajectory(scene.cameras.world_from_cam, scene.names)
    if not path.exists():
        raise ProjectError(f"{path}: no such file or folder; expected a trajectory")
    if path.is_file() and path.suffix.lower() != ".npz" and not holds_views(path):
        return read_poses(path, layout=layout)
    if path.suffix.lower() == ".npz" or (path / "run.json").is_file():
        from gvtools.runs.run import load_memory

        views = load_memory(path).views
        cameras = views.cameras
        # A scan's stations are no poses of a camera.
        if cameras is None or views.scanned.all():
            raise ProjectError(f"{path}: a memory without views; expected at least one")
        # A view that was fused twice is one pose.
        first = {cameras.names[row]: row for row in np.flatnonzero(~views.scanned)[::-1].tolist()}
        cameras = cameras[sorted(first.values())]
        return Trajectory(cameras.world_from_cam, cameras.names)
    model = find_model(path) if path.is_dir() else None
    if model is not None:
        images = load_model(model, faces=True).images
        poses = invert_rigid(np.array([image.cam_from_world for image in images]))
        return Trajectory(poses, tuple(image.name for image in images))
    from gvtools.scenes.project import open_project

    cameras = open_project(path).cameras
    return Trajectory(cameras.world_from_cam, cameras.names)


def associate(
    reference: Trajectory,
    estimate: Trajectory,
    *,
    how: str = "auto",
    max_difference: float,
    offset: float = 0.0,
) -> tuple[Rows, Rows, str, tuple[str, ...]]:
    """Rows of both trajectories that belong together, how they were found, and what is doubtful.

    Args:
        how: "time" (pictures' names may be times), "name", "index" (the order), or "auto": the
            first of these that both have.
        max_difference: of times that belong together, seconds.
        offset: added to the estimate's times, seconds.
    """
    timed = [track.stamps is not None for track in (reference, estimate)]
    named = [bool(track.names) for track in (reference, estimate)]
    doubts: tuple[str, ...] = ()
    if how == "auto":
        how = "time" if all(timed) else "name" if all(named) else "index"
        if how == "index" and any(timed) and any(named):
            doubts = (
                "paired in their order alone, as one has names and the other times: wrong from "
                "the first pose on that only one of both has",
            )
    if how == "index":
        return (*by_index(len(reference), len(estimate)), how, doubts)
    if how == "name":
        if not all(named):
            raise OptionError(
                "association by name: a TUM, KITTI or EuRoC file has no names; use time or index"
            )
        return (*by_name(reference.names, estimate.names), how, doubts)
    if reference.stamps is None or estimate.stamps is None:
        raise OptionError("association by time: a trajectory has no times; use name or index")
    at, times = reference.stamps, estimate.stamps
    match = partial(by_time, max_difference=max_difference, offset=offset)
    if found := _other_unit(at, times, match):
        times = times * found[0]
        how += f" (the estimate's stamps are {found[1]} of the reference's)"
    first, second = match(at, times)
    gap = float(np.median(np.abs(at[first] - times[second] - offset)))
    steps = [np.median(np.diff(stamps)) for stamps in (at, times) if len(stamps) > 1]
    if gap > FAR * max(steps, default=np.inf):
        doubts = (
            f"times of pairs differ by {gap:.3g} s (median), and poses are {max(steps):.3g} s "
            "apart: other moments may be paired; give an offset or a smaller largest difference",
        )
    else:
        poses, again = (reference.poses, estimate.poses), partial(match, offset=0.0)
        doubts = _other_rate(poses, (at, times + offset), rows=(first, second), match=again)
    return first, second, how, doubts


def _other_rate(
    poses: tuple[Float64, Float64],
    stamps: tuple[Float64, Float64],
    *,
    rows: tuple[Rows, Rows],
    match: Match,
) -> tuple[str, ...]:
    """What is said where few find a partner, or a clock of another rate would mend the errors."""
    at, times = stamps

    def error(first: Rows, second: Rows) -> float:
        pair = poses[0][first], poses[1][second]
        found = absolute_errors(*pair, refuse_mirrored=False).translation_share
        return np.inf if found is None else found.rmse

    low, high = max(at.min(), times.min()), min(at.max(), times.max())
    both = min(int(((low <= stamps) & (stamps <= high)).sum()) for stamps in (at, times))
    few, given = len(rows[0]) < PARTNERS * both, error(*rows)
    tried = []
    if min(len(at), len(times)) >= trajectories.FEW and (few or given > trajectories.NOTABLE):
        steps = [np.median(np.diff(stamps)) for stamps in (at, times)]
        rates = {np.ptp(at) / np.ptp(times), steps[0] / steps[1], *RATES}
        for rate, start in product(rates, (times[0], 0.0)):
            with suppress(DegenerateError):
                pairs = match(at, start + rate * (times - start))
                if len(pairs[0]) >= max(trajectories.FEW, len(rows[0])):
                    tried.append((error(*pairs), len(pairs[0]), 1 / rate))
    best, count, fast = min(tried, default=(np.inf, 0, 1.0))
    if best < trajectories.EXPLAINED * given or (
        few and best < trajectories.NOTABLE and count > 2 * PARTNERS * len(rows[0])
    ):
        return (
            f"the estimate's clock seems to run {fast:.4g} times as fast as the reference's: with "
            f"its times divided by that, {count} poses find a partner instead of {len(rows[0])}, "
            f"with an ATE of {best:.4g} of the extent instead of {given:.4g}; mend its times, "
            "or, of frames' numbers, --associate index",
        )
    return few * (
        f"{len(rows[0])} of {both} poses of the time that both cover find a partner: the figures "
        "are of these; clocks may differ (--offset), or their rates",
    )


def _other_unit(at: Float64, times: Float64, match: Match) -> tuple[float, str] | None:
    """The factor under which most times find partners, where without it hardly any does."""

    def pairs(factor: float) -> int:
        try:
            return len(match(at, times * factor)[0])
        except DegenerateError:
            return 0

    as_given, least = pairs(1), max(3, min(len(at), len(times)) / 2)
    names = {1e-3: "thousandths", 1e-6: "millionths", 1e-9: "billionths"}
    names |= {10.0**n: f"10^{n} fold" for n in (3, 6, 9)}
    for factor, name in names.items():
        if (count := pairs(factor)) >= least and count > 2 * as_given:
            return factor, name
    return None
