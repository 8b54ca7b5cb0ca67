"""Gaussians and meshes on the web viewer's page: what is sent, and what a browser makes of it."""

from __future__ import annotations

import numpy as np
import pytest
from box_project import write_box
from browser import open_browser
from export_runs import export_run, saved_run
from PIL import Image
from plain_splats import draw, read_splats
from web_page import SCENE, close_notes, served, steady, wait

from pipelines.viewing.source import ViewSource
from viz.viewer.nodes import MAGNIFIED
from viz.viewer.run_view import POINTS, SPLATS


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_box(tmp_path_factory.mktemp("box"))


@pytest.fixture(scope="module", params=[True, False], ids=["fitted", "points"])
def run(scene, request, tmp_path_factory):
    return saved_run(scene, tmp_path_factory.mktemp("run") / "run", fitted=request.param)


@pytest.fixture(scope="module")
def viewer(run):
    with served(ViewSource(run.folder).read()) as found:
        yield found


def unpacked(viewer):
    """Centres, covariances and RGBA that the page has, in the world's frame; and their rounds."""
    centers, covariances, rgba, rounds = [], [], [], []
    scale = viewer.frame.scale * MAGNIFIED
    for number, node in viewer._gaussians._nodes.items():
        assert node.scale == 1 / MAGNIFIED
        buffer = np.ascontiguousarray(node.buffer)
        centers.append(buffer[:, :3].copy().view("<f4") / scale + viewer.frame.origin)
        halves = buffer[:, 4:7].copy().view("<f2").astype(np.float64) / scale**2
        covariances.append(halves[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3))
        rgba.append(buffer[:, 7:].copy().view(np.uint8))
        rounds += [number] * len(buffer)
    return np.concatenate(centers), np.concatenate(covariances), np.concatenate(rgba), rounds


def test_the_page_gets_the_gaussians_of_the_exported_file(viewer, run, tmp_path):
    viewer._show_look(SPLATS)
    centers, covariances, rgba, rounds = unpacked(viewer)
    export_run(run.folder, "splat", tmp_path / "out.ply")
    file = read_splats(tmp_path / "out.ply")
    order, other = np.lexsort(centers.round(4).T), np.lexsort(file["positions"].round(4).T)
    np.testing.assert_allclose(centers[order], file["positions"][other], atol=2e-4)
    # Twice the trace is no matter of the order of places that are rounded alike.
    sizes = np.sort(np.trace(covariances, axis1=1, axis2=2))
    np.testing.assert_allclose(sizes, np.sort((file["sizes"] ** 2).sum(axis=1)), rtol=5e-3)
    # As the page has it, every one is a Gaussian still.
    assert np.linalg.eigvalsh(covariances).min() > 0
    opacities = np.sort(rgba[:, 3] / 255)
    np.testing.assert_allclose(opacities, np.sort(file["opacities"]), atol=1.01 / 255)
    # The fit counts as round 0; without it each round has its points.
    assert set(rounds) == ({0, 2} if run.appearance else {0, 1, 2})


def test_rounds_and_looks_say_which_nodes_are_shown(viewer):
    nodes = viewer._gaussians._nodes
    points = viewer._points._nodes
    viewer._show_look(SPLATS)
    assert all(node.visible for node in nodes.values())
    assert not any(node.visible for node in points.values())
    viewer._gaussians.show(0)
    assert [round for round, node in nodes.items() if node.visible] == [0]
    viewer._gaussians.show(2)
    assert all(node.visible for node in nodes.values())
    viewer._show_look(POINTS)
    assert not any(node.visible for node in nodes.values())
    assert all(node.visible for node in points.values())


@pytest.mark.slow
def test_a_browser_draws_them_as_a_plain_rasteriser_does(viewer, run, scene, tmp_path):
    viewer._show_look(SPLATS)
    viewer._cameras.set_kinds(dict.fromkeys(("context", "target"), False))
    export_run(run.folder, "splat", tmp_path / "out.ply")
    file = read_splats(tmp_path / "out.ply")
    shown = viewer.run.gaussians_of(viewer.budget)
    np.testing.assert_allclose(shown.centers, file["positions"], atol=1e-6)
    _, _, rgba, _ = unpacked(viewer)
    file["harmonics"] = ((rgba[:, :3] / 255 - 0.5) / 0.28209479)[:, None]
    with open_browser() as browser:
        browser.driver.get(viewer.url)
        wait(lambda: "observations after round" in browser.text())
        close_notes(browser)
        client = wait(lambda: next(iter(viewer.server.get_clients().values()), None))
        wxyz, position = viewer.frame.placement(scene.cameras[1])
        client.camera.wxyz, client.camera.position = wxyz, position
        client.flush()
        wait(lambda: np.linalg.norm(np.array(client.camera.position) - position) < 1e-3)
        seen = steady(browser)
        camera = viewer.frame.client_camera(client, longest=1280)
        canvas = browser.driver.find_element("css selector", "canvas").rect
        # viser's quads for Gaussians have no z, of which three.js says this once.
        assert [e for e in browser.console_errors() if "Computed radius is NaN" not in e] == []
    size = (int(camera.width[0]), int(camera.height[0]))
    assert size == (round(canvas["width"]), round(canvas["height"]))
    pose, K = camera.cam_from_world[0], camera.K[0]
    expected = draw(file, pose, K, size=size)
    # White Gaussians show the share of light that all stop; the page behind them is white.
    white = {**file, "harmonics": np.full((len(file["positions"]), 1, 3), 0.5 / 0.28209479)}
    expected += 1 - draw(white, pose, K, size=size)
    whole = np.rint(255 * np.clip(expected, 0, 1)).astype(np.uint8)[SCENE]
    Image.fromarray(np.concatenate([seen, whole])).save(tmp_path / "seen.png")
    # Where there are Gaussians.
    there = whole.min(axis=2) < 200
    assert there.mean() > 0.5
    assert np.abs(seen[there].astype(float) - whole[there]).mean() < 8
