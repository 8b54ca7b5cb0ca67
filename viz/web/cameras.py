"""Cameras in the web viewer: frusta that hold their pictures, and the flight to one."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras
from gvtools.errors import GvError
from viz.plots.canvas import COLORS, RED
from viz.run_view.view import CONTEXT, TARGET, TRUTH, RunView, ShownCamera
from viz.web.frame import TYPICAL, PageFrame

if TYPE_CHECKING:
    import viser

KINDS = {CONTEXT: COLORS["observed"], TARGET: COLORS["generated"]}
# Longer side of the picture in a frustum, pixels.
THUMBNAIL = 192
# Depth of a frustum, as a share of the typical depth of what is seen; less where there are many.
SHARE = 0.06
MANY = 20
FLIGHT_STEPS, FLIGHT_SECONDS = 20, 0.5

Clicked = Callable[[ShownCamera, "viser.ClientHandle | None"], None]


class CameraNodes:
    """A frustum for each camera, added in the background, so that points come first.

    Args:
        server: that shows them.
        frame: to show them in.
        on_click: told which camera was clicked, and by whom.
    """

    def __init__(self, server: viser.ViserServer, frame: PageFrame, on_click: Clicked) -> None:
        self._server = server
        self._frame = frame
        self._on_click = on_click
        self._nodes: dict[tuple[str, str, int], viser.CameraFrustumHandle] = {}
        self._marked: tuple[str, str, int] | None = None
        self._round = 0
        self._kinds = dict.fromkeys(KINDS, True)
        # Where a viewer stands who looks out of a camera: its own and its neighbours' pictures
        # would hang before their eyes.
        self._inside: NDArray[np.float64] | None = None
        self._arrived = False
        self._depth = 1.0
        self._adder: threading.Thread | None = None
        self._adding = threading.Lock()
        self._stopped = threading.Event()

    def set_cameras(self, run: RunView) -> None:
        """Add the cameras of a run that are not there yet, in the background."""
        self._adder = threading.Thread(target=self._add_new, args=(run,), daemon=True)
        self._adder.start()

    def show(self, number: int) -> None:
        """Show the cameras of the rounds up to ``number``."""
        self._round = number
        for (_, kind, round), node in list(self._nodes.items()):
            node.visible = self._shows(kind, round)

    def enter(self, position: NDArray[np.float64]) -> None:
        """Hide all frusta from a viewer who goes to (3,) ``position``, until they have left it.

        Of the page, as that of ``moved``.
        """
        self._inside, self._arrived = position, False
        self.show(self._round)

    def moved(self, position: NDArray[np.float64]) -> None:
        """A viewer stands at (3,) ``position`` now."""
        if self._inside is None:
            return
        away = float(np.linalg.norm(position - self._inside)) > self._depth
        if not away:
            self._arrived = True
        elif self._arrived:
            self._inside = None
            self.show(self._round)

    def _shows(self, kind: str, round: int) -> bool:
        return self._inside is None and self._kinds[kind] and round <= self._round

    def set_kinds(self, kinds: dict[str, bool]) -> None:
        """Show or hide the context's and the targets' cameras."""
        self._kinds = kinds
        self.show(self._round)

    def mark(self, shown: ShownCamera) -> None:
        """Paint the selected camera, and the one before in its own colour again."""
        if self._marked in self._nodes:
            self._nodes[self._marked].color = rgb_of(KINDS[self._marked[1]])
        self._marked = _key(shown)
        if self._marked in self._nodes:
            self._nodes[self._marked].color = rgb_of(RED)

    def stop(self) -> None:
        """Add no more."""
        self._stopped.set()
        if self._adder is not None:
            self._adder.join()

    def _add(self, run: RunView, shown: ShownCamera) -> viser.CameraFrustumHandle:
        camera = shown.camera
        width, height = int(camera.width[0]), int(camera.height[0])
        wxyz, position = self._frame.placement(camera)
        self._depth = SHARE * TYPICAL * min(1.0, (MANY / len(run.cameras)) ** 0.5)
        node = self._server.scene.add_camera_frustum(
            f"/cameras/{shown.kind}/{len(self._nodes):05d}",
            fov=vertical_field_of_view(camera),
            aspect=width / height,
            scale=self._depth,
            thickness=0.02 * self._depth,
            color=rgb_of(RED if _key(shown) == self._marked else KINDS[shown.kind]),
            wxyz=wxyz,
            position=position,
            visible=self._shows(shown.kind, shown.round),
            cast_shadow=False,
            receive_shadow=False,
        )

        @node.on_click
        def _(event: viser.SceneNodePointerEvent[viser.CameraFrustumHandle]) -> None:
            self._on_click(shown, event.client)

        return node

    def _add_new(self, run: RunView) -> None:
        with self._adding:
            new = [shown for shown in run.cameras if _key(shown) not in self._nodes]
            for shown in new:
                if not self._stopped.is_set():
                    self._nodes[_key(shown)] = self._add(run, shown)
        self._add_pictures(run, new)

    def _add_pictures(self, run: RunView, cameras: list[ShownCamera]) -> None:
        for shown in cameras:
            if self._stopped.is_set():
                return
            try:
                pictures = run.pictures(shown)
            except GvError:
                continue  # The panel says so when the camera is selected.
            picture = pictures.get("completion", pictures.get(TRUTH))
            if picture is not None and not self._stopped.is_set():
                self._nodes[_key(shown)].image = thumbnail(picture, THUMBNAIL)


def fly_to(
    client: viser.ClientHandle, camera: Cameras, frame: PageFrame, *, goes_on: Callable[[], bool]
) -> None:
    """Move a client's camera to where a camera of the run stands, within half a second.

    Args:
        client: whose.
        camera: a batch of one.
        frame: of the page.
        goes_on: asked before each step; False ends the flight.
    """
    from viser.transforms import SO3

    wxyz, position = frame.placement(camera)
    start, goal = SO3(np.array(client.camera.wxyz)), SO3(wxyz)
    turn = (start.inverse() @ goal).log()
    origin = np.array(client.camera.position)
    field_of_view = vertical_field_of_view(camera)
    for step in range(1, FLIGHT_STEPS + 1):
        if not goes_on():
            return
        share = step / FLIGHT_STEPS
        share = share * share * (3 - 2 * share)
        with client.atomic():
            client.camera.fov = field_of_view
            client.camera.wxyz = (start @ SO3.exp(share * turn)).wxyz
            client.camera.position = (1 - share) * origin + share * position
        client.flush()
        time.sleep(FLIGHT_SECONDS / FLIGHT_STEPS)


def vertical_field_of_view(camera: Cameras) -> float:
    """Of a batch of one, radians."""
    return float(2 * np.arctan(camera.height[0] / (2 * camera.K[0, 1, 1])))


def thumbnail(picture: NDArray[np.uint8], side: int) -> NDArray[np.uint8]:
    """The picture (H, W, 3) with no side longer than ``side`` pixels."""
    from PIL import Image

    image = Image.fromarray(picture)
    image.thumbnail((side, side), Image.Resampling.BOX, reducing_gap=2.0)
    return np.array(image)


def _key(shown: ShownCamera) -> tuple[str, str, int]:
    return shown.name, shown.kind, shown.round


def rgb_of(color: str) -> tuple[int, int, int]:
    """A colour "#rrggbb" as bytes."""
    return int(color[1:3], 16), int(color[3:5], 16), int(color[5:7], 16)
