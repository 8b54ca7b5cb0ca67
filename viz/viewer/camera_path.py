"""A camera path made on the page: key frames, the spline through them, and its file.

The file is what ``gvtools film --path FILE`` reads: a ``transforms.json`` of the film's frames,
beside the run in ``paths/NAME.json``.
"""

from __future__ import annotations

import re
import tempfile
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gvtools.cameras import Cameras, concatenate
from gvtools.errors import GvError, OptionError
from gvtools.scenes.transforms import write_transforms, written_here
from gvtools.trajectories import interpolate
from viz.plots.canvas import GREEN, rgb_of
from viz.viewer.nodes import SHARE, add_frustum, vertical_field_of_view
from viz.viewer.run_view import RunView
from viz.viewer.standpoint import TYPICAL, PageFrame, pinhole

if TYPE_CHECKING:
    import viser

FOLDER = "paths"
# As ``gvtools film`` has them, unless it is told otherwise.
FRAMES, FPS = 120, 24.0
# Of frames where no view of the run has a size.
SIZE = (1280, 720)
# A file's name comes from a page: letters that mean nothing to a file system.
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")
# Cameras of the line through the key frames.
LINE_CAMERAS = 200


class CameraPath:
    """Key frames, shared by all who look; the run's first camera gives the frames their size.

    ``saves``: True writes beside the run, False sends the file to the browser.
    """

    def __init__(
        self, server: viser.ViserServer, frame: PageFrame, run: RunView, *, saves: bool
    ) -> None:
        self._server, self._frame, self._saves = server, frame, saves
        run_folder = run.path if run.path.is_dir() else run.path.parent
        self.folder = run_folder / FOLDER
        first = run.cameras[0].camera if run.cameras else None
        self._size = SIZE if first is None else (int(first.width[0]), int(first.height[0]))
        self.keys: list[Cameras] = []
        self._nodes: list[viser.SceneNodeHandle] = []
        self._lock = threading.RLock()
        # For each client the number of its last preview: another one, or its end, stops it.
        self._previews: dict[int, int] = {}
        self._add_controls()

    def _add_controls(self) -> None:
        gui = self._server.gui
        with gui.add_folder("Camera path", expand_by_default=False):
            self._status = gui.add_html("")
            add = gui.add_button("Add key frame", hint="at the present view")
            remove = gui.add_button("Remove last")
            self._frames = gui.add_number("Frames", FRAMES, min=2, max=10_000, step=1)
            preview = gui.add_button("Preview", hint=f"{FPS:g} frames a second; again: stop")
            self._name = gui.add_text("Name", "path", hint="letters, digits, - and _")
            save = gui.add_button("Save", hint="for gvtools film --path")
        self._update_status()

        remove.on_click(lambda _: self.remove_last())
        for button, act in ((add, self.add), (preview, self.preview), (save, self.save)):
            button.on_click(partial(_act, act))

    def add(self, client: viser.ClientHandle) -> None:
        """A key frame where a client stands."""
        seen = self._frame.client_camera(client, longest=max(self._size))
        pose, view = seen.cam_from_world[0], vertical_field_of_view(seen)
        with self._lock:
            self.keys.append(pinhole(pose, self._size, view, name=f"{len(self.keys):05d}"))
            self._draw()

    def remove_last(self) -> None:
        """Take the last key frame back, if there is one."""
        with self._lock:
            del self.keys[-1:]
            self._draw()

    def cameras(self, count: int) -> Cameras:
        """The path's cameras, world frame."""
        if len(self.keys) < 2:
            raise OptionError(f"{len(self.keys)} key frames; expected 2 or more")
        return interpolate(concatenate(self.keys), count)

    def save(self, client: viser.ClientHandle) -> Path | None:
        """Write the path, or send it to a client; returns the file that was written."""
        name = self._name.value
        if not NAME.fullmatch(name):
            raise OptionError("the name; expected letters, digits, - and _, at most 64")
        cameras = self.cameras(int(self._frames.value))
        pictures = [f"{name}/{number:05d}.png" for number in range(len(cameras))]
        file = f"{name}.json"
        if not self._saves:
            with tempfile.TemporaryDirectory() as folder:
                write_transforms(Path(folder) / file, cameras, image_paths=pictures)
                content = (Path(folder) / file).read_bytes()
            client.send_file_download(file, content, save_immediately=True)
            return None
        path = self.folder / file
        if path.exists() and not written_here(path):
            raise OptionError(f"{path} is there already and is no path; choose another name")
        write_transforms(path, cameras, image_paths=pictures)
        client.add_notification("Saved", f"gvtools film {self.folder.parent} --path {path}")
        return path

    def preview(self, client: viser.ClientHandle) -> None:
        """Lead a client along the path at the film's pace; while one runs, stop it."""
        with self._lock:
            number = self._previews.get(client.client_id, 0) + 1
            self._previews[client.client_id] = number
            if number % 2 == 0:
                return
        try:
            cameras = self.cameras(int(self._frames.value))
            self._set_visible(False)
            start = time.monotonic()
            for index, camera in enumerate(cameras):
                if self._previews[client.client_id] != number:
                    return
                wxyz, position = self._frame.placement(camera)
                with client.atomic():
                    client.camera.fov = vertical_field_of_view(camera)
                    client.camera.wxyz, client.camera.position = wxyz, position
                client.flush()
                time.sleep(max(0.0, start + (index + 1) / FPS - time.monotonic()))
        finally:
            self._set_visible(True)
            with self._lock:
                if self._previews[client.client_id] == number:
                    self._previews[client.client_id] = number + 1

    def _set_visible(self, visible: bool) -> None:
        for node in self._nodes:
            node.visible = visible

    def _draw(self) -> None:
        """The key frames and the line through them."""
        for node in self._nodes:
            node.remove()
        depth = SHARE * TYPICAL
        self._nodes = [
            add_frustum(
                self._server, self._frame, key,
                name=f"/path/keys/{number:05d}", color=GREEN, depth=depth, thickness=0.03,
            )
            for number, key in enumerate(self.keys)
        ]  # fmt: skip
        try:
            centers = self.cameras(LINE_CAMERAS).centers
        except GvError:
            self._update_status()
            return
        page = self._frame.scale * (centers - self._frame.origin)
        self._nodes.append(
            self._server.scene.add_line_segments(
                "/path/line",
                np.stack([page[:-1], page[1:]], axis=1).astype(np.float32),
                rgb_of(GREEN),
                thickness=0.03 * depth,
            )
        )
        self._update_status()

    def _update_status(self) -> None:
        count = len(self.keys)
        text = "no key frames yet" if not count else f"{count} key frame{'s' * (count > 1)}"
        self._status.content = f'<div style="padding:0 .8em .4em;font-size:.85em">{text}</div>'


def _act(
    act: Callable[[viser.ClientHandle], object], event: viser.GuiEvent[viser.GuiButtonHandle]
) -> None:
    """Act for the client of an event, who is told what is wrong."""
    if event.client is None:
        return
    try:
        act(event.client)
    except GvError as error:
        event.client.add_notification("Camera path", str(error), color="red")
