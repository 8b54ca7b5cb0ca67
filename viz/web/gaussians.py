"""Gaussians and meshes in the web viewer, drawn by the browser."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from viz.run_view.gaussians import ShownGaussians, Surface
from viz.web.frame import PageFrame

if TYPE_CHECKING:
    import viser

# Covariances go to the page in half precision, whose range is narrow: in units in which the page's
# has this many, standard deviations from 3e-6 to LARGEST / MAGNIFIED page units keep digits.
MAGNIFIED, LARGEST = 32.0, 250.0


class GaussianNodes:
    """One node a round; sorted and blended over all of them by the page.

    Args:
        server: that shows them.
        frame: of the page.
    """

    def __init__(self, server: viser.ViserServer, frame: PageFrame) -> None:
        self._server = server
        self._frame = frame
        self._nodes: dict[int, viser.GaussianSplatHandle] = {}
        self._visible, self._round = False, 0

    def set_gaussians(self, gaussians: ShownGaussians) -> None:
        """Show others."""
        self.clear()
        scale = self._frame.scale
        centers = ((gaussians.centers - self._frame.origin) * (scale * MAGNIFIED)).astype("f4")
        covariances = gaussians.covariances(scale * MAGNIFIED, largest=LARGEST)
        rgb, opacities = gaussians.colors, gaussians.opacities
        for number in np.unique(gaussians.rounds).tolist():
            rows = np.flatnonzero(gaussians.rounds == number)
            self._nodes[number] = self._server.scene.add_gaussian_splats(
                f"/splats/round_{number:03d}",
                centers[rows],
                covariances[rows],
                rgb[rows],
                opacities[rows],
                scale=1 / MAGNIFIED,
                visible=self._visible and number <= self._round,
            )

    def clear(self) -> None:
        """Show none."""
        for node in self._nodes.values():
            node.remove()
        self._nodes = {}

    def show(self, number: int) -> None:
        """Show the rounds up to ``number``."""
        self._round = number
        for round, node in self._nodes.items():
            node.visible = self._visible and round <= number

    def set_visible(self, visible: bool) -> None:
        """Show or hide all."""
        self._visible = visible
        self.show(self._round)

    def __bool__(self) -> bool:
        """Whether there are any."""
        return bool(self._nodes)


def add_surface(
    server: viser.ViserServer, frame: PageFrame, surface: Surface
) -> viser.SceneNodeHandle:
    """A mesh with the colours of its vertices, seen from both sides."""
    import trimesh

    vertices = (surface.vertices - frame.origin) * frame.scale
    mesh = trimesh.Trimesh(
        vertices, surface.faces, vertex_colors=surface.colors, process=False, validate=False
    )
    # Colours of photographs hold the light already.
    return server.scene.add_mesh_trimesh("/mesh", mesh, cast_shadow=False, receive_shadow=False)
