"""The web viewer's scene: points, a mesh, cameras, and what is drawn behind them."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras
from gvtools.errors import GvError
from viz.page.page import PageCamera, SharedPage, page_html
from viz.plots.canvas import RED, rgb_of
from viz.viewer.colors import KINDS
from viz.viewer.render import RunRenderer, picture_of
from viz.viewer.run_view import (
    POINTS,
    RENDERED,
    SPLATS,
    TRUTH,
    ColoredMesh,
    Detail,
    RunView,
    ShownCamera,
)
from viz.viewer.standpoint import TYPICAL, PageFrame

if TYPE_CHECKING:
    import viser

# Longer side of the picture in a frustum, pixels.
THUMBNAIL = 192
# Depth of a frustum, as a share of the typical depth of what is seen; less where there are many.
SHARE = 0.06
MANY = 20
FLIGHT_STEPS, FLIGHT_SECONDS = 20, 0.5
# Longer side of a rendered picture, pixels.
LONGEST = 960
# The page's depth maps end there, in its units; what lies behind is drawn there.
FARTHEST = 167.0
# What the browser runs when it is told where to look; of HTML that comes later, it runs no others.
DRAW_PAGE = """
const frame = document.getElementById('splats') ?? document.createElement('iframe');
frame.id = 'splats';
frame.style = 'position: absolute; width: 100%; height: 100%; border: 0';
if (!this.alt) frame.remove();
else {
  if (!frame.parentElement) document.querySelector('canvas').parentElement.prepend(frame);
  frame.contentWindow.location.replace(this.alt);
}"""
NO_SHADOW: dict[str, Any] = {"cast_shadow": False, "receive_shadow": False}

CameraKey = tuple[str, str, int]


class PointNodes:
    """The memory's points, a node a round, the same for all who look."""

    def __init__(self, server: viser.ViserServer, frame: PageFrame) -> None:
        self._server = server
        self._frame = frame
        self._nodes: dict[int, Any] = {}
        self._visible, self._round = True, 0
        # By round, places within ``rows``.
        self._places: dict[int, NDArray[np.int64]] = {}
        self._scale = 1.0
        self.rows: NDArray[np.int64] = np.zeros(0, np.int64)
        self.size = 0.0

    def set_points(self, run: RunView, detail: Detail, rgb: NDArray[np.uint8]) -> None:
        """Show other points in colours (P, 3); rounds that have not changed are not sent again."""
        memory = run.memory
        before = {key: self.rows[places] for key, places in self._places.items()}
        same_size = detail.size == self.size
        self.rows, self.size = detail.rows, detail.size
        rounds = memory.views.round[memory.columns.view[detail.rows]]
        self._places = {int(key): np.flatnonzero(rounds == key) for key in np.unique(rounds)}
        for key in [k for k in self._nodes if k not in self._places]:
            self._nodes.pop(key).remove()
        for key, places in self._places.items():
            rows = detail.rows[places]
            if same_size and key in before and np.array_equal(before[key], rows):
                self._recolor(key, rgb[places])
                continue
            self._nodes[key] = self._server.scene.add_point_cloud(
                f"/points/round_{key:03d}",
                self._frame.points(memory.columns.positions[rows]),
                rgb[places],
                point_size=self._point_size(),
                point_shape="square",
                point_shading="flat",
                precision="float32",
                visible=self._shows(key),
            )

    def show(self, number: int) -> None:
        """Show the rounds up to ``number``."""
        self._round = number
        for round, node in self._nodes.items():
            node.visible = self._shows(round)

    def set_visible(self, visible: bool) -> None:
        """Show or hide all."""
        self._visible = visible
        self.show(self._round)

    def _shows(self, round: int) -> bool:
        return self._visible and round <= self._round

    def recolor(self, rgb: NDArray[np.uint8]) -> None:
        """Other colours (P, 3) of the same points."""
        for key, places in self._places.items():
            self._recolor(key, rgb[places])

    def _recolor(self, key: int, rgb: NDArray[np.uint8]) -> None:
        node = self._nodes[key]
        if not np.array_equal(node.colors, rgb):
            node.colors = rgb

    def set_size(self, scale: float) -> None:
        """Draw points ``scale`` times their spacing wide."""
        self._scale = scale
        for node in self._nodes.values():
            node.point_size = self._point_size()

    def _point_size(self) -> float:
        return self._frame.scale * self.size * self._scale

    def count(self, number: int) -> int:
        """How many points there are of the rounds up to ``number``."""
        return sum(len(places) for round, places in self._places.items() if round <= number)


def add_surface(
    server: viser.ViserServer, frame: PageFrame, surface: ColoredMesh
) -> viser.SceneNodeHandle:
    """A mesh with the colours of its vertices, seen from both sides."""
    import trimesh

    vertices = (surface.vertices - frame.origin) * frame.scale
    mesh = trimesh.Trimesh(
        vertices, surface.faces, vertex_colors=surface.colors, process=False, validate=False
    )
    # Colours of photographs hold the light already.
    return server.scene.add_mesh_trimesh("/mesh", mesh, **NO_SHADOW)


def add_frustum(
    server: viser.ViserServer,
    frame: PageFrame,
    camera: Cameras,
    *,
    name: str,
    color: str,
    depth: float,
    thickness: float,
) -> viser.CameraFrustumHandle:
    """A camera, a batch of one, as a pyramid ``depth`` units of the page high."""
    wxyz, position = frame.placement(camera)
    return server.scene.add_camera_frustum(
        name,
        fov=vertical_field_of_view(camera),
        aspect=int(camera.width[0]) / int(camera.height[0]),
        scale=depth,
        thickness=thickness * depth,
        color=rgb_of(color),
        wxyz=wxyz,
        position=position,
        **NO_SHADOW,
    )


class CameraNodes:
    """A frustum for each camera, added in the background, so that points come first.

    ``on_click`` is told which camera was clicked, and by whom.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        frame: PageFrame,
        on_click: Callable[[ShownCamera, viser.ClientHandle | None], None],
    ) -> None:
        self._server = server
        self._frame = frame
        self._on_click = on_click
        self._nodes: dict[CameraKey, viser.CameraFrustumHandle] = {}
        self._marked: CameraKey | None = None
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
        """Hide all frusta from a viewer who goes to a place of the page, until they leave it."""
        self._inside, self._arrived = position, False
        self.show(self._round)

    def moved(self, position: NDArray[np.float64]) -> None:
        """A viewer stands at a place of the page now."""
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
        self._depth = SHARE * TYPICAL * min(1.0, (MANY / len(run.cameras)) ** 0.5)
        node = add_frustum(
            self._server,
            self._frame,
            shown.camera,
            name=f"/cameras/{shown.kind}/{len(self._nodes):05d}",
            color=RED if _key(shown) == self._marked else KINDS[shown.kind],
            depth=self._depth,
            thickness=0.02,
        )
        node.visible = self._shows(shown.kind, shown.round)
        node.on_click(lambda event: self._on_click(shown, event.client))
        return node

    def _add_new(self, run: RunView) -> None:
        with self._adding:
            new = [shown for shown in run.cameras if _key(shown) not in self._nodes]
            for shown in new:
                if not self._stopped.is_set():
                    self._nodes[_key(shown)] = self._add(run, shown)
        for shown in new:
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

    ``goes_on`` is asked before each step; False ends the flight.
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


class Backdrop:
    """Each client's own view behind the scene, for the looks that follow its camera.

    Rendered by the project's splatter here, or drawn in the browser by the page to share, which
    ``pages`` then holds for the server, by its address.
    """

    def __init__(
        self, server: viser.ViserServer, frame: PageFrame, pages: dict[str, bytes]
    ) -> None:
        self._frame = frame
        self._pages = pages
        self._renderer: RunRenderer | None = None
        self._page: SharedPage | None = None
        self._number = 0
        self._look, self._round, self._mode = POINTS, 0, "color"
        self._asked = threading.Event()
        self._stopped = False
        self._clients: dict[int, tuple[viser.ClientHandle, viser.GuiHtmlHandle]] = {}
        self._seen: dict[int, tuple[Any, ...]] = {}
        server.on_client_connect(self._follow)
        server.on_client_disconnect(self._forget)
        self._worker = threading.Thread(target=self._work, daemon=True)
        self._worker.start()

    def set_run(self, run: RunView) -> None:
        """Draw another run, or the same one grown."""
        self._renderer, self._page = RunRenderer(run), None
        self._asked.set()

    def set_state(self, look: str, number: int, mode: str) -> None:
        """Draw the memory after a round, in the colours of a mode, if the look follows cameras."""
        self._look, self._round, self._mode = look, number, mode
        self._asked.set()

    def prepare_page(self, run: RunView, budget: int) -> None:
        """Make the run's page, unless it is there."""
        if self._page is None and run.page_of is not None:
            page = run.page_of(run, budget)
            content = page_html(page).encode(errors="backslashreplace")
            # Another address, so that no browser takes the one before for it.
            self._number += 1
            self._pages.clear()
            self._pages[self._address] = content
            self._page = page

    @property
    def _address(self) -> str:
        return f"/splats_{self._number}.html"

    def stop(self) -> None:
        """End for good."""
        self._stopped = True
        self._asked.set()
        self._worker.join()

    def _follow(self, client: viser.ClientHandle) -> None:
        self._clients[client.client_id] = client, client.gui.add_html("")
        client.camera.on_update(lambda _: self._asked.set())
        self._asked.set()

    def _forget(self, client: viser.ClientHandle) -> None:
        self._clients.pop(client.client_id, None)

    def _work(self) -> None:
        while not self._stopped:
            self._asked.wait()
            # Whatever changes from here on is for the next turn.
            self._asked.clear()
            for client, html in list(self._clients.values()):
                self._draw(client, html)

    def _draw(self, client: viser.ClientHandle, html: viser.GuiHtmlHandle) -> None:
        look, page, rendered = self._look, self._page, self._look == RENDERED
        camera = self._frame.client_camera(client, longest=LONGEST if rendered else np.inf)
        drawn = look, self._round, self._mode, self._renderer, page
        state = (*drawn, camera.K.tobytes(), camera.cam_from_world.tobytes())
        before = self._seen.get(client.client_id, (look,))
        if before == state:
            return
        self._seen[client.client_id] = state
        address = ""
        if look == SPLATS and page is not None:
            view = PageCamera(camera).view(page.origin).values()
            numbers = ",".join(str(number) for part in view for number in part)
            address = f"{self._address}#v={numbers}&round={self._round}&bare=1"
        html.content = f'<img src="data:," alt="{address}" onerror="{DRAW_PAGE}" hidden>'
        if rendered:
            self._render(client, camera)
        elif before[0] == RENDERED:
            client.scene.set_background_image(None)

    def _render(self, client: viser.ClientHandle, camera: Cameras) -> None:
        if self._renderer is None:
            return
        try:
            guidance = self._renderer.render(camera, round=self._round, mode=self._mode)
        except GvError as error:
            client.add_notification("Not rendered", str(error), color="red")
            return
        depth = np.where(guidance.valid[0], self._frame.scale * guidance.depth[0], FARTHEST)
        client.scene.set_background_image(
            picture_of(guidance), format="jpeg", jpeg_quality=90, depth=np.minimum(depth, FARTHEST)
        )


def vertical_field_of_view(camera: Cameras) -> float:
    """Of a batch of one, radians."""
    return float(2 * np.arctan(camera.height[0] / (2 * camera.K[0, 1, 1])))


def thumbnail(picture: NDArray[np.uint8], side: int) -> NDArray[np.uint8]:
    """The picture (H, W, 3) with no side longer than ``side`` pixels."""
    from PIL import Image

    image = Image.fromarray(picture)
    image.thumbnail((side, side), Image.Resampling.BOX, reducing_gap=2.0)
    return np.array(image)


def _key(shown: ShownCamera) -> CameraKey:
    return shown.name, shown.kind, shown.round
