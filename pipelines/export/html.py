"""One page to share: the run's Gaussians, drawn by the browser as the run draws them.

Gaussians come in groups, one for each round and source, which the page shows or hides.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gvtools.errors import GvError
from gvtools.files import write_text
from gvtools.scenes.inspection import spread
from gvtools.splats import SH, Splats
from pipelines.export.formats import ExportOptions
from pipelines.export.source import ExportSource
from viz.page.page import PageCamera, PageGroup, SharedPage, pack_gaussians, page_html
from viz.report.pictures import thumbnail
from viz.viewer.run_view import RunView, cameras_of
from viz.viewer.standpoint import camera_outside

if TYPE_CHECKING:
    from gvtools.appearance.appearance import Appearance

# Of the memory, beside fitted Gaussians, where the user gives no number.
MAX_POINTS = 400_000
# Pictures beside the scene, and the longer side of each [px].
MOST_PICTURES, SIDE = 200, 160
# Browsers hold no text of more than 512 MB; so many Gaussians take 128 at most.
MOST_IN_GROUP = 1_000_000
# Nearest that points are drawn, where there is no fit, in typical depths.
NEAR = 0.01


def write_html(source: ExportSource, path: Path, options: ExportOptions) -> str:
    """Write the page."""
    memory, fit = source.memory, source.appearance
    most = options.max_points
    if most is None:
        most = MAX_POINTS + (0 if fit is None else len(fit.gaussians))
    splats = source.splats(options.model_copy(update={"max_points": most}), exposed=False)
    run = RunView(source.path, memory, cameras=cameras_of(memory, ()), told_up=source.up)
    return write_page(page_of(run, splats, cameras=list(_cameras(source)), fit=fit), splats, path)


def write_page(page: SharedPage, splats: Splats, path: Path) -> str:
    """Write the page of Gaussians, of a run or of a file."""
    write_text(path, page_html(page))
    size = path.stat().st_size / 1e6
    pictures = sum(camera.picture is not None for camera in page.cameras)
    return f"{splats.summary()} and {pictures} pictures in {path}, {size:.1f} MB"


def page_of(
    run: RunView,
    splats: Splats,
    *,
    cameras: Sequence[PageCamera] = (),
    fit: Appearance | None = None,
) -> SharedPage:
    """The page of Gaussians, into which no exposures are baked; ``fit`` tells them."""
    depth = run.typical_depth
    return SharedPage(
        title=run.title,
        summary=f"{len(splats):,} Gaussians",
        groups=list(_groups(splats)),
        cameras=cameras,
        start=cameras[0] if cameras else PageCamera(camera_outside(run)),
        origin=splats.origin,
        up=run.up(),
        mip=splats.mode == "mip",
        backdrop=fit is not None and fit.backdrop,
        depth=depth,
        near=NEAR * depth if fit is None else fit.near,
        exposures=None if fit is None else fit.exposures,
        exposed_in=None if fit is None else fit.gaussians.frame,
    )


def _groups(splats: Splats) -> Iterator[PageGroup]:
    fitted = np.arange(len(splats)) < (len(splats) if splats.fitted is None else splats.fitted)
    keys = np.stack([splats.rounds, splats.generated, fitted], axis=1)
    for number, generated, whole in np.unique(keys, axis=0):
        chosen = np.flatnonzero((keys == (number, generated, whole)).all(axis=1))
        for rows in np.array_split(chosen, -(-len(chosen) // MOST_IN_GROUP)):
            # Points have one colour each.
            part = replace(splats, values=splats.values[rows, : None if whole else SH + 3])
            words = pack_gaussians(
                part.positions, log_scales=part.log_scales, quaternions=part.quaternions,
                logits=part.logits, harmonics=part.harmonics,
            )  # fmt: skip
            yield PageGroup(int(number), bool(generated), bool(whole), words)


def _cameras(source: ExportSource) -> Iterator[PageCamera]:
    """Cameras of the photographs, with their pictures where they can be read."""
    views = [view.camera for view in source.memory.views.photographed if view.camera.width[0] > 1]
    for camera in (views[row] for row in spread(len(views), MOST_PICTURES)):
        name, picture = camera.names[0], None
        if name in source.project:
            with suppress(GvError):
                picture = thumbnail(name, source.project[name].load().rgb, side=SIDE)
        yield PageCamera(camera, picture)
