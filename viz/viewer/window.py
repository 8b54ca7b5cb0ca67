"""The Open3D window: the same data and colours as the web viewer, and keys for rounds."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gvtools.errors import OptionError
from gvtools.o3d import o3d
from viz.plots.canvas import rgb_of
from viz.viewer.colors import KINDS, MODES, point_colors
from viz.viewer.run_view import RunView, detail
from viz.viewer.standpoint import PageFrame, home

BUDGET = 4_000_000
WIDTH, HEIGHT = 1280, 800
# GLFW's numbers of the arrow keys.
RIGHT, LEFT, DOWN, UP = 262, 263, 264, 265
KEYS = (
    "right, left: a round on or back; C: next colour; up, down: look from the next or previous "
    "camera; F: cameras on or off; Q: end"
)
# Depth of a camera's pyramid, as a share of the typical depth.
SHARE = 0.04


class Open3dViewer:
    """One window on a run.

    It begins with a round, None for the last, in the colours of a mode; ``say`` is told, in one
    line, what is shown whenever that has changed.
    """

    def __init__(
        self,
        run: RunView,
        *,
        round: int | None = None,
        mode: str = "color",
        say: Callable[[str], None] = print,
    ) -> None:
        self.run = run
        self.round = run.last_round if round is None else round
        self.mode = mode
        self._say = say
        self._camera = 0
        self._with_cameras = True
        self._detail = detail(run.memory, BUDGET)
        self._rounds = run.round_of_points()[self._detail.rows]
        self._cloud = o3d.geometry.PointCloud()
        self._pyramids: list[tuple[int, o3d.geometry.LineSet]] = []
        self._rgb = np.zeros((0, 3))
        self._fill()
        self.window = o3d.visualization.VisualizerWithKeyCallback()
        if not self.window.create_window(f"gvtools: {run.title}", WIDTH, HEIGHT):
            raise OptionError("--open3d: no window could be opened; use --screenshot FILE")
        self.window.add_geometry(self._cloud)
        self._pyramids = [self._pyramid(k) for k in range(len(run.cameras))]
        self._add_pyramids()
        self._bind()
        self.look_from(0)

    def run_until_closed(self) -> None:
        """Show the window until it is closed."""
        self._say(KEYS)
        self._tell()
        self.window.run()
        self.window.destroy_window()

    def step_round(self, step: int) -> None:
        """Go ``step`` rounds on."""
        self.round = int(np.clip(self.round + step, 0, self.run.last_round))
        self._refresh()

    def next_mode(self) -> None:
        """The next colour mode."""
        modes = list(MODES)
        self.mode = modes[(modes.index(self.mode) + 1) % len(modes)]
        self._rgb = np.zeros((0, 3))
        self._refresh()

    def look_from(self, number: int) -> None:
        """Stand where a camera of the run stood; without cameras, in front of the whole cloud."""
        if not self.run.cameras:
            position, look_at = home(self.run, PageFrame.of(self.run))
            view, turn = self.window.get_view_control(), self.run.memory.frame.axes.T
            view.set_front(turn @ (position - look_at))
            view.set_up(turn @ self.run.up())
            return
        self._camera = number % len(self.run.cameras)
        shown = self.run.cameras[self._camera]
        view = self.window.get_view_control()
        parameters = view.convert_to_pinhole_camera_parameters()
        local = self.run.memory.frame.seen_from(shown.camera)
        width, height = parameters.intrinsic.width, parameters.intrinsic.height
        focal = float(shown.camera.K[0, 1, 1] * height / shown.camera.height[0])
        # The window takes its own centre alone.
        parameters.intrinsic = o3d.camera.PinholeCameraIntrinsic(
            width, height, focal, focal, width / 2 - 0.5, height / 2 - 0.5
        )
        # All points have one size, pixels: as wide as they are at mid depth.
        width_px = 1.2 * focal * self._detail.size / self.run.typical_depth
        self.window.get_render_option().point_size = float(np.clip(width_px, 2.0, 8.0))
        parameters.extrinsic = local.cam_from_world[0]
        view.convert_from_pinhole_camera_parameters(parameters, allow_arbitrary=True)

    def toggle_cameras(self) -> None:
        """Show or hide the cameras."""
        self._with_cameras = not self._with_cameras
        self._refresh()

    def _fill(self) -> None:
        memory, rows = self.run.memory, self._detail.rows
        if not len(self._rgb):
            colors = point_colors(memory, self.mode, rows=rows, true_depth=self.run.recorded_depth)
            self._rgb, self._legend = colors.rgb / 255.0, colors.legend
        there = self._rounds <= self.round
        self._cloud.points = o3d.utility.Vector3dVector(memory.columns.positions[rows[there]])
        self._cloud.colors = o3d.utility.Vector3dVector(self._rgb[there])

    def _refresh(self) -> None:
        self._fill()
        self.window.update_geometry(self._cloud)
        for _, pyramid in self._pyramids:
            self.window.remove_geometry(pyramid, reset_bounding_box=False)
        self._add_pyramids()
        self._tell()

    def _add_pyramids(self) -> None:
        for number, pyramid in self._pyramids:
            if self._with_cameras and number <= self.round:
                self.window.add_geometry(pyramid, reset_bounding_box=False)

    def _pyramid(self, index: int) -> tuple[int, o3d.geometry.LineSet]:
        shown = self.run.cameras[index]
        local = self.run.memory.frame.seen_from(shown.camera)
        lines = o3d.geometry.LineSet.create_camera_visualization(
            int(local.width[0]),
            int(local.height[0]),
            local.K[0],
            local.cam_from_world[0],
            SHARE * self.run.typical_depth,
        )
        lines.paint_uniform_color([value / 255 for value in rgb_of(KINDS[shown.kind])])
        return shown.round, lines

    def _bind(self) -> None:
        def on(key: int, action: Callable[[], None]) -> None:
            def pressed(window: object) -> bool:
                action()
                return False

            self.window.register_key_callback(key, pressed)

        on(RIGHT, lambda: self.step_round(1))
        on(LEFT, lambda: self.step_round(-1))
        on(UP, lambda: self.look_from(self._camera + 1))
        on(DOWN, lambda: self.look_from(self._camera - 1))
        on(ord("C"), self.next_mode)
        on(ord("F"), self.toggle_cameras)

    def _tell(self) -> None:
        counts = self.run.counts(self.round)
        scale = f" ({' to '.join(self._legend.scale)})" if self._legend.scale else ""
        self._say(
            f"round {self.round} of {self.run.last_round}: {counts.summary()}; "
            f"{MODES[self.mode]}: {self._legend.text}{scale}"
        )
