"""A picture of a run without a window or a display, rendered by the project's own splatter."""

from __future__ import annotations

from pathlib import Path

from gvtools.errors import OptionError
from gvtools.files import replaced_when_written
from viz.run_view.from_outside import camera_outside
from viz.run_view.render import RunRenderer, picture_of
from viz.run_view.view import CONTEXT, RunView, ShownCamera


def write_screenshot(
    path: Path, run: RunView, shown: ShownCamera, *, round: int, mode: str
) -> None:
    """Write a run seen by one of its cameras as PNG, white where nothing is known.

    Args:
        path: the file.
        run: what to show.
        shown: where to look from.
        round: the memory as it was after it.
        mode: of viz.run_view.point_colors.MODES.
    """
    from PIL import Image

    guidance = RunRenderer(run).render(shown.camera, round=round, mode=mode)
    with replaced_when_written(path) as temporary:
        Image.fromarray(picture_of(guidance)).save(temporary, format="PNG")


def chosen_camera(run: RunView, name: str | None) -> ShownCamera:
    """The camera of a view, or the first of the context; outside of a cloud without cameras."""
    if not run.cameras and name is None:
        return ShownCamera("outside", CONTEXT, 0, camera_outside(run))
    if name is None:
        return next((c for c in run.cameras if c.kind == CONTEXT), run.cameras[0])
    for shown in run.cameras:
        if shown.name == name:
            return shown
    names = [shown.name for shown in run.cameras]
    if not names:
        raise OptionError(f"--camera {name!r}: {run.path} holds no cameras; leave the option out")
    raise OptionError(
        f"--camera {name!r}: no such view; expected one of {len(names)}, such as {names[0]!r} or "
        f"{names[-1]!r}"
    )
