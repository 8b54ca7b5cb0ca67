"""A picture of a run without a window: by Open3D where it can render, else by our own splatter."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras
from gvtools.errors import OptionError
from gvtools.files import replaced_when_written
from viz.run_view.detail import detail, point_pixels
from viz.run_view.point_colors import point_colors
from viz.run_view.render import RunRenderer, picture_of
from viz.run_view.view import CONTEXT, RunView, ShownCamera

# Points that Open3D is given at most.
BUDGET = 4_000_000
# Open3D's start and rendering in software take that long on a slow machine.
PATIENCE = 120.0
CHILD = ("-m", "viz.open3d.offscreen")


@dataclass(frozen=True, eq=False)
class Screenshot:
    """A picture, and who made it.

    Attributes:
        rgb: (H, W, 3) uint8; white where nothing is known.
        by: "open3d" or "splatter".
        why: the reason where Open3D could not.
    """

    rgb: NDArray[np.uint8]
    by: str
    why: str | None = None


def take_screenshot(
    run: RunView, camera: Cameras, *, round: int, mode: str = "color", open3d: bool = False
) -> Screenshot:
    """A run seen by a camera.

    Args:
        run: what to show.
        camera: a batch of one.
        round: the memory as it was after it.
        mode: of viz.run_view.point_colors.MODES.
        open3d: let Open3D render where there is EGL or X; the splatter steps in where there is not.
    """
    why = None
    if open3d:
        found = _by_open3d(run, camera, round, mode)
        if not isinstance(found, str):
            return Screenshot(found, "open3d")
        why = found
    guidance = RunRenderer(run).render(camera, round=round, mode=mode)
    return Screenshot(picture_of(guidance), "splatter", why)


def chosen_camera(run: RunView, name: str | None) -> ShownCamera:
    """The camera of a view, or the first of the context.

    Raises:
        OptionError: no such view, or no cameras at all.
    """
    if not run.cameras:
        raise OptionError(f"{run.path}: holds no cameras to look from; expected a run's memory")
    if name is None:
        return next((c for c in run.cameras if c.kind == CONTEXT), run.cameras[0])
    for shown in run.cameras:
        if shown.name == name:
            return shown
    names = [shown.name for shown in run.cameras]
    raise OptionError(
        f"--camera {name!r}: no such view; expected one of {len(names)}, such as {names[0]!r} or "
        f"{names[-1]!r}"
    )


def write_screenshot(path: Path, rgb: NDArray[np.uint8]) -> None:
    """Write (H, W, 3) uint8 as PNG.

    Raises:
        ProjectError: it cannot be written.
    """
    from PIL import Image

    with replaced_when_written(path) as temporary:
        Image.fromarray(rgb).save(temporary, format="PNG")


def _by_open3d(run: RunView, camera: Cameras, round: int, mode: str) -> NDArray[np.uint8] | str:
    """The picture, or why there is none. In a process of its own: Open3D may abort."""
    memory = run.memory
    drawn = detail(memory, BUDGET)
    there = run.round_of_points()[drawn.rows] <= round
    colors = point_colors(memory, mode, rows=drawn.rows[there], true_depth=run.recorded_depth)
    frame = memory.frame.seen_from(camera)
    with tempfile.TemporaryDirectory() as folder:
        given, made = Path(folder) / "given.npz", Path(folder) / "made.npy"
        np.savez(
            given,
            positions=memory.columns.positions[drawn.rows[there]],
            rgb=colors.rgb,
            K=frame.K[0],
            cam_from_local=frame.cam_from_world[0],
            size=np.array([int(camera.width[0]), int(camera.height[0])]),
            pixels=point_pixels(float(camera.K[0, 0, 0]), drawn, run),
        )
        # Without a display, Mesa renders to memory.
        environment = dict(os.environ)
        if not environment.get("DISPLAY"):
            environment.setdefault("EGL_PLATFORM", "surfaceless")
        command = [sys.executable, *CHILD, str(given), str(made)]
        try:
            done = subprocess.run(
                command, env=environment, timeout=PATIENCE, capture_output=True, check=False
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            return f"Open3D did not render ({type(error).__name__})"
        if done.returncode or not made.is_file():
            lines = done.stderr.decode(errors="replace").strip().splitlines()
            last = lines[-1].removeprefix("RuntimeError: ") if lines else f"exit {done.returncode}"
            return f"Open3D cannot: {last}"
        return np.load(made, allow_pickle=False)
