"""Gaussians and meshes on the web viewer's page: what is sent, and what a browser makes of it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from box_project import write_box
from browser import free_port, open_browser
from export_runs import export_run, saved_run
from PIL import Image
from plain_splats import draw, read_splats
from web_page import SCENE, close_notes, steady, wait

from pipelines.viewing.source import ViewSource
from viz.run_view.gaussians import THINNEST, ShownGaussians
from viz.run_view.view import MESH, POINTS, SPLATS

pytest.importorskip("viser", reason="viser is not installed (extra web)")

from viz.web.gaussians import LARGEST, MAGNIFIED
from viz.web.viewer import WebViewer


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_box(tmp_path_factory.mktemp("box"))


@pytest.fixture(scope="module", params=[True, False], ids=["fitted", "points"])
def run(scene, request, tmp_path_factory):
    return saved_run(scene, tmp_path_factory.mktemp("run") / "run", fitted=request.param)


@pytest.fixture(scope="module")
def viewer(run):
    found = WebViewer(ViewSource(run.folder).read(), port=free_port())
    yield found
    found.stop()


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
    export_run(run.folder, "--format", "splat", "--out", tmp_path / "out.ply")
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
    export_run(run.folder, "--format", "splat", "--out", tmp_path / "out.ply")
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
    expected = draw(file, camera.cam_from_world[0], camera.K[0], size=size)
    whole = np.rint(255 * np.clip(expected, 0, 1)).astype(np.uint8)[SCENE]
    Image.fromarray(np.concatenate([seen, whole])).save(tmp_path / "seen.png")
    # Where the plain one is not black from lack of Gaussians.
    there = whole.max(axis=2) > 20
    assert there.mean() > 0.5
    assert np.abs(seen[there].astype(float) - whole[there]).mean() < 8


def test_thin_and_huge_gaussians_stay_within_half_precision():
    values = np.zeros((3, 38), np.float32)
    values[:, 6] = 1
    values[:, 3:6] = np.log([[1e-6, 0.01, 0.02], [0.1, 0.1, 1e9], [1e-3, 1e-3, 1e-3]])
    shown = ShownGaussians(values, np.zeros(3), np.zeros(3, np.int32))
    halves = shown.covariances(MAGNIFIED, largest=LARGEST).astype(np.float16)
    assert np.isfinite(halves).all()
    diagonal = np.sqrt(np.diagonal(halves.astype(float), axis1=1, axis2=2)) / MAGNIFIED
    np.testing.assert_allclose(diagonal[2], 1e-3, rtol=0.02)
    np.testing.assert_allclose(diagonal[0], [0.02 * THINNEST, 0.01, 0.02], rtol=0.02)
    assert diagonal[1, 2] == pytest.approx(LARGEST / MAGNIFIED, rel=1e-3)


def test_a_mesh_is_on_the_page_where_it_is_in_the_file(run, tmp_path):
    trimesh = pytest.importorskip("trimesh")
    export_run(run.folder, "--format", "mesh", "--out", tmp_path / "mesh.ply")
    shown = ViewSource(tmp_path / "mesh.ply").read()
    viewer = WebViewer(shown, port=free_port())
    mesh: Any = viewer._mesh
    assert shown.surface is not None
    try:
        assert mesh.visible and not any(n.visible for n in viewer._points._nodes.values())
        sent = trimesh.load_scene(
            trimesh.util.wrap_as_stream(mesh.glb_data), file_type="glb"
        ).to_mesh()
        world = sent.vertices / viewer.frame.scale + viewer.frame.origin
        np.testing.assert_allclose(world, shown.surface.vertices, atol=1e-5)
        assert len(sent.faces) == len(shown.surface.faces)
        viewer._show_look(POINTS)
        assert not mesh.visible
        viewer._show_look(MESH)
        assert mesh.visible
    finally:
        viewer.stop()


def test_a_damaged_fit_is_said_on_the_page(scene, tmp_path):
    run = saved_run(scene, tmp_path / "run", fitted=True)
    viewer = WebViewer(ViewSource(run.folder).read(), port=free_port())
    try:
        (run.folder / "round_000" / "appearance.npz").write_bytes(b"PK")
        viewer._show_look(SPLATS)
        assert "no splats: " in viewer._panel._note.content
        assert "appearance.npz" in viewer._panel._note.content
        viewer._show_look(POINTS)
        assert all(node.visible for node in viewer._points._nodes.values())
    finally:
        viewer.stop()


HOSTILE = "<img src=x onerror=window.hurt=1>\"'&amp;"


@pytest.mark.slow
def test_hostile_names_are_text_on_the_page(scene, tmp_path):
    run = saved_run(scene, tmp_path / HOSTILE, fitted=False)
    export_run(run.folder, "--format", "splat", "--out", tmp_path / f"{HOSTILE}.ply")
    viewer = WebViewer(ViewSource(tmp_path / f"{HOSTILE}.ply").read(), port=free_port())
    viewer.set_note(HOSTILE)
    try:
        with open_browser() as browser:
            browser.driver.get(viewer.url)
            wait(lambda: "observations after round" in browser.text())
            assert HOSTILE in browser.text()
            client = wait(lambda: next(iter(viewer.server.get_clients().values()), None))
            name: Any = viewer.path._name
            name.value = HOSTILE
            viewer.path._for(client, viewer.path.save)
            wait(lambda: "expected letters" in browser.text())
            hurt = "return [window.hurt || 0, document.querySelectorAll('img[src=x]').length]"
            assert browser.driver.execute_script(hurt) == [0, 0]
    finally:
        viewer.stop()
