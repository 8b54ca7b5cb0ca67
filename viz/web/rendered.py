"""What the viewer's own camera sees, rendered by the project's splatter behind the scene."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING

import numpy as np

from gvtools.errors import GvError
from viz.run_view.render import RunRenderer, picture_of
from viz.run_view.view import RunView
from viz.web.frame import PageFrame

if TYPE_CHECKING:
    import viser

# Longer side of a rendered picture, pixels.
LONGEST = 960
# The page's depth maps end there, in its units; what lies behind is drawn there.
FARTHEST = 167.0


class RenderedLook:
    """Renders for each client whenever its camera, the round or the colour mode has changed.

    Args:
        server: whose clients look.
        frame: that they look in.
    """

    def __init__(self, server: viser.ViserServer, frame: PageFrame) -> None:
        self._server = server
        self._frame = frame
        self._renderer: RunRenderer | None = None
        self._round, self._mode, self._on = 0, "color", False
        self._asked = threading.Event()
        self._stopped = False
        self._cleared = True
        self._seen: dict[int, tuple[object, ...]] = {}
        server.on_client_connect(self._follow)
        self._worker = threading.Thread(target=self._work, daemon=True)
        self._worker.start()

    def set_run(self, run: RunView) -> None:
        """Render another run, or the same one grown."""
        self._renderer = RunRenderer(run)
        self._ask()

    def set_state(self, number: int, mode: str) -> None:
        """Render the memory after a round, in the colours of a mode."""
        self._round, self._mode = number, mode
        self._ask()

    def set_on(self, on: bool) -> None:
        """Begin or end."""
        self._on = on
        self._ask()

    def stop(self) -> None:
        """End for good."""
        self._stopped = True
        self._asked.set()
        self._worker.join()

    def _ask(self) -> None:
        self._seen = {}
        self._asked.set()

    def _follow(self, client: viser.ClientHandle) -> None:
        client.camera.on_update(lambda _: self._asked.set())

    def _work(self) -> None:
        while not self._stopped:
            self._asked.wait()
            # Whatever changes from here on is for the next turn.
            self._asked.clear()
            if self._on:
                self._cleared = False
                for client in self._server.get_clients().values():
                    self._render(client)
            elif not self._cleared:
                self._cleared = True
                for client in self._server.get_clients().values():
                    client.scene.set_background_image(None)

    def _render(self, client: viser.ClientHandle) -> None:
        renderer, number, mode = self._renderer, self._round, self._mode
        if renderer is None:
            return
        camera = self._frame.client_camera(client, longest=LONGEST)
        state = (number, mode, id(renderer), camera.K.tobytes(), camera.cam_from_world.tobytes())
        if self._seen.get(client.client_id) == state:
            return
        self._seen[client.client_id] = state
        try:
            guidance = renderer.render(camera, round=number, mode=mode)
        except GvError as error:
            client.add_notification("Not rendered", str(error), color="red")
            return
        depth = np.where(guidance.valid[0], self._frame.scale * guidance.depth[0], FARTHEST)
        client.scene.set_background_image(
            picture_of(guidance), format="jpeg", jpeg_quality=90, depth=np.minimum(depth, FARTHEST)
        )
