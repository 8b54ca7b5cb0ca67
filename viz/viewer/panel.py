"""The web viewer's controls, and the pictures of the selected camera side by side."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import GvError
from viz.viewer.colors import CONTEXT, KINDS, MODES, TARGET, VIRIDIS, Legend
from viz.viewer.nodes import thumbnail
from viz.viewer.run_view import TRUTH, Detail, RunView, ShownCamera

if TYPE_CHECKING:
    import viser

    from viz.viewer.web import WebViewer

NO_CAMERA = "none"
LOOKS_HINT = "splats: as the page of gvtools export; rendered: as gvtools render draws this view"
# Of the panel with the selected camera's pictures, CSS pixels: a little over half of the scene in a
# window of 1280. It can be moved, made larger and folded away.
PICTURES_WIDTH = 500
# Of the pictures that stand side by side, in order.
SHOWN = ("guidance", "completion", TRUTH)
PICTURE_SIDE = 640
# Of the row of pictures at least, pixels.
ROW_WIDTH = 760
GAP = 8


@dataclass(frozen=True, eq=False)
class ShownPictures:
    """The pictures of a camera."""

    title: str  # HTML, what they are of and what is not there
    names: tuple[str, ...]  # left to right, "" where there is none
    row: NDArray[np.uint8] | None  # (H, W, 3), side by side; None where there are none


def shown_pictures(run: RunView, shown: ShownCamera) -> ShownPictures:
    """Read the pictures of a camera; what cannot be read is said in the title."""
    title = f"<b>{escape(shown.name)}</b>, {shown.kind}, round {shown.round}"
    if shown.coverage is not None:
        before, after = (f"{100 * share:.1f} %" for share in shown.coverage)
        title += f", coverage {before} before the round, {after} after it"
    try:
        pictures = run.pictures(shown)
    except GvError as error:
        pictures = {}
        title += f"<br>{escape(str(error))}"
    there = [name for name in SHOWN if name in pictures]
    absent = [name for name in SHOWN if name not in pictures and shown.kind == TARGET]
    if absent:
        title += f"<br>not there: {', '.join(absent)}"
    names = {TRUTH: "given picture"} if shown.kind == CONTEXT else {}
    padded = (*(names.get(name, name) for name in there), *[""] * (len(SHOWN) - len(there)))
    row = side_by_side([pictures[name] for name in there]) if there else None
    return ShownPictures(title, padded, row)


def side_by_side(pictures: list[NDArray[np.uint8]]) -> NDArray[np.uint8]:
    """Up to three pictures (H, W, 3) in a row of three, as high as the first.

    Small ones are enlarged by a whole factor, so that the row fills its panel.
    """
    from PIL import Image

    small = [thumbnail(picture, PICTURE_SIDE) for picture in pictures]
    factor = -(-ROW_WIDTH // (len(SHOWN) * small[0].shape[1]))
    first = small[0].repeat(factor, axis=0).repeat(factor, axis=1)
    height = len(first)
    cells = [first]
    for picture in small[1:]:
        width = max(1, round(picture.shape[1] * height / picture.shape[0]))
        image = Image.fromarray(picture).resize((width, height), Image.Resampling.NEAREST)
        cells.append(np.array(image))
    cells += [np.full_like(first, 255)] * (len(SHOWN) - len(cells))
    gap = np.full((height, GAP, 3), 255, np.uint8)
    return np.concatenate([part for cell in cells for part in (cell, gap)][:-1], axis=1)


class Panel:
    """Controls on the right, pictures below left; the viewer is told what was chosen."""

    def __init__(self, viewer: WebViewer, *, mode: str) -> None:
        gui = viewer.server.gui
        self._run: RunView | None = None
        self._by_label: dict[str, ShownCamera] = {}
        gui.main_panel.dock_right()
        gui.main_panel.set_width(320)
        # A slider of no length cannot be drawn; set_run gives it the run's.
        self._round = gui.add_slider("Round", 0, 1, 1, 0, disabled=True)
        self._counts = gui.add_html("")
        self._mode = gui.add_dropdown("Colour", tuple(MODES.values()), initial_value=MODES[mode])
        self._legend = gui.add_html("")
        self._look = gui.add_dropdown("Look", viewer.run.looks, hint=LOOKS_HINT)
        self._size = gui.add_slider("Point size", 0.25, 4.0, 0.25, 1.0, hint="in spacings")
        self._camera = gui.add_dropdown("Camera", (NO_CAMERA,), hint="choose or click one")
        kinds = {
            kind: gui.add_checkbox(label, initial_value=True, hint=f"show the {kind} cameras")
            for kind, label in ((CONTEXT, "Context"), (TARGET, "Targets"))
        }
        self._note = gui.add_html(_key_of_cameras())
        download = gui.add_button("Download PLY")
        self._pictures = gui.add_panel(visible=False)
        with self._pictures.add_tab("Pictures"):
            self._caption = gui.add_html("")
            self._strip = gui.add_image(np.full((8, 24, 3), 255, np.uint8), jpeg_quality=88)
        self._pictures.float(x=12, y=-12, width=PICTURES_WIDTH)

        self._round.on_update(lambda event: viewer.show_round(int(event.target.value)))
        self._mode.on_update(lambda _: viewer.show_mode(self.mode))
        self._look.on_update(lambda event: viewer.show_look(str(event.target.value)))
        self._size.on_update(lambda event: viewer.set_size(float(event.target.value)))

        def show_kinds(_: object) -> None:
            viewer.cameras.set_kinds({kind: box.value for kind, box in kinds.items()})

        for box in kinds.values():
            box.on_update(show_kinds)

        @self._camera.on_update
        def _(event: viser.GuiEvent[viser.GuiDropdownHandle[str]]) -> None:
            # Without a client the choice was set from here, by a click in the scene.
            if event.client is not None and self._camera.value in self._by_label:
                viewer.select(self._by_label[self._camera.value], event.client)

        @download.on_click
        def _(event: viser.GuiEvent[viser.GuiButtonHandle]) -> None:
            if event.client is not None and self._run is not None:
                self._download(self._run, event.client)

    @property
    def round(self) -> int:
        """The round that is looked at."""
        return int(self._round.value)

    @property
    def mode(self) -> str:
        """The colour mode that is looked at, of MODES."""
        return next(mode for mode, label in MODES.items() if label == self._mode.value)

    def set_run(self, run: RunView, detail: Detail, *, go_to: int) -> None:
        """Take a run, or its growth, over, and go to a round."""
        self._run = run
        self._detail = detail
        if run.last_round:
            self._round.max = run.last_round
            self._round.disabled = False
        if go_to != self.round:
            _set(self._round, go_to)
        self._by_label = {_label(shown): shown for shown in run.cameras}
        labels = (NO_CAMERA, *self._by_label)
        if self._camera.options != labels:
            chosen = self._camera.value
            self._camera.options = labels
            _set(self._camera, chosen if chosen in labels else NO_CAMERA)

    def set_size(self, spacing: float) -> None:
        """Say what a size of 1 is."""
        self._size.hint = f"in spacings of {spacing:.3g} scene units"

    def set_counts(self, run: RunView, number: int, points: int) -> None:
        """Say what the memory holds after a round, and how much of it is drawn."""
        counts = run.counts(number)
        lines = [
            f"<b>{counts.total:,}</b> observations after round {number}",
            counts.summary(),
        ]
        if counts.voxels is not None:
            lines.append(f"{counts.voxels:,} voxels")
        if self._detail.edge:
            lines.append(f"{points:,} points drawn, one a cell of {self._detail.edge:.3g}")
        if not run.whole:
            lines.append(f"not finished: {run.last_round} of {(run.planned or 1) - 1} rounds done")
        self._counts.content = _small("<br>".join(lines))

    def set_legend(self, legend: Legend) -> None:
        """How to read the colours."""
        parts = [escape(legend.text)]
        if legend.scale is not None:
            low, high = (escape(end) for end in legend.scale)
            parts.append(
                f'<div style="height:.8em;background:linear-gradient(90deg,{",".join(VIRIDIS)})">'
                '</div><div style="display:flex;justify-content:space-between">'
                f"<span>{low}</span><span>{high}</span></div>"
            )
        parts += [_swatch(color, meaning) for color, meaning in legend.swatches]
        self._legend.content = _small("".join(f"<div>{part}</div>" for part in parts))

    def select(self, shown: ShownCamera) -> None:
        """Let the list of cameras name the one that was clicked."""
        if _label(shown) in self._by_label:
            _set(self._camera, _label(shown))

    def set_pictures(self, pictures: ShownPictures) -> None:
        """Show what there is to see of a camera."""
        if pictures.row is not None:
            self._strip.image = pictures.row
        self._strip.visible = pictures.row is not None
        cells = "".join(
            f'<span style="flex:1;text-align:center">{name}</span>' for name in pictures.names
        )
        self._caption.content = _small(f'{pictures.title}<div style="display:flex">{cells}</div>')
        self._pictures.visible = True

    def set_note(self, text: str) -> None:
        """Something that the user should know of the run."""
        self._note.content = _key_of_cameras() + _small(escape(text))

    def _download(self, run: RunView, client: viser.ClientHandle) -> None:
        from gvtools.memory.ply import export_memory_ply

        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"{run.title}.ply"
            try:
                export_memory_ply(run.memory, path)
                content = path.read_bytes()
            except (GvError, OSError) as error:
                client.add_notification("No PLY", str(error), color="red")
                return
        client.send_file_download(path.name, content, save_immediately=True)


def _set(control: Any, value: object) -> None:
    """Its value, which viser's types call read-only although it takes one."""
    control.value = value


def _label(shown: ShownCamera) -> str:
    return f"{shown.kind} {shown.round}: {shown.name}"


def _key_of_cameras() -> str:
    swatches = "".join(_swatch(color, f"{kind} camera") for kind, color in KINDS.items())
    return _small(swatches)


def _swatch(color: str, meaning: str) -> str:
    box = f"display:inline-block;width:.8em;height:.8em;margin-right:.4em;background:{color}"
    return f'<span style="margin-right:1em"><span style="{box}"></span>{escape(meaning)}</span>'


def _small(html: str) -> str:
    return f'<div style="padding:0 .8em .4em;font-size:.85em;line-height:1.45">{html}</div>'
