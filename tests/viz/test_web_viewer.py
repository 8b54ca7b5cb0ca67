"""The web viewer: its page, and the look "splats" behind the scene."""

from __future__ import annotations

import base64
import http.client
import io
import re
import shutil
import sys
import threading
import time
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from box_project import write_box
from browser import Browser, open_browser
from export_runs import export_run, saved_run
from memory_scenes import camera
from PIL import Image
from web_page import PATIENCE, choose, close_notes, served, steady, wait

from gvtools.ply import write_ply
from pipelines.viewing.source import ViewSource
from viz.viewer.nodes import LONGEST
from viz.viewer.panel import GAP, ROW_WIDTH
from viz.viewer.render import RunRenderer, picture_of
from viz.viewer.run_view import POINTS, SPLATS, TARGET
from viz.viewer.web import address_of, is_loopback, may_read


@pytest.fixture(scope="module")
def viewer(small_run):
    with served(ViewSource(small_run).read()) as found:
        yield found


@pytest.fixture(scope="module")
def browser(viewer):
    with open_browser() as found:
        found.driver.get(viewer.url)
        wait(lambda: "observations after round 2" in found.text())
        close_notes(found)
        yield found
        # Whatever the tests did, nothing went wrong on the page and nothing left the machine.
        assert found.console_errors() == []
        assert found.foreign_requests() == []


def painted(picture) -> int:
    """Pixels that are not background."""
    return int((picture < 250).any(axis=2).sum())


@pytest.mark.slow
def test_the_slider_shows_the_memory_growing(browser, viewer):
    counts = [viewer.run.counts(number) for number in range(3)]
    thumb = browser.driver.find_element("css selector", "[role=slider]")
    last = steady(browser)
    assert painted(last) > 0.05 * last[..., 0].size
    sizes = [painted(last)]
    for number in (1, 0):
        thumb.send_keys("\ue012")  # the left arrow
        wait(lambda number=number: f"observations after round {number}" in browser.text())
        text = browser.text()
        assert f"{counts[number].observed + counts[number].generated:,} observations" in text
        assert f"{counts[number].generated:,} generated" in text
        last = steady(browser, last)
        sizes.append(painted(last))
    assert sizes[0] > sizes[1] > sizes[2] > 0
    thumb.send_keys("\ue014\ue014")
    wait(lambda: "observations after round 2" in browser.text())


def test_a_click_on_a_camera_flies_there_and_shows_its_pictures(browser, viewer):
    client = next(iter(viewer.server.get_clients().values()))
    # The last one stands in front of no other.
    target = viewer.run.cameras[-1]
    x, y = on_screen(client, viewer, target)
    click(browser, x, y)
    wait(lambda: f"{target.name}, {TARGET}, round 2" in browser.text())
    text = browser.text()
    for title in ("guidance", "completion", "truth", "before the round"):
        assert title in text
    _, goal = viewer.frame.placement(target.camera)
    wait(lambda: np.linalg.norm(np.array(client.camera.position) - goal) < 1e-3)
    (row,) = wait(lambda: shown_picture(browser))
    pictures = viewer.run.pictures(target)
    width = pictures["completion"].shape[1]
    factor = (row.shape[1] - 2 * GAP) // (3 * width)
    assert row.shape[1] == 3 * factor * width + 2 * GAP >= ROW_WIDTH
    for number, title in enumerate(("guidance", "completion", "truth")):
        left = number * (factor * width + GAP)
        part = row[factor // 2 :: factor, left : left + factor * width][:, factor // 2 :: factor]
        assert np.abs(part.astype(int) - pictures[title]).mean() < 6, title


@pytest.mark.slow
def test_the_splatter_renders_the_viewers_own_view(browser, viewer):
    before = steady(browser)
    choose(browser, "points", "rendered")
    steady(browser, before)
    client = next(iter(viewer.server.get_clients().values()))
    camera = viewer.frame.client_camera(client, longest=LONGEST)
    expected = picture_of(RunRenderer(viewer.run).render(camera, round=2))
    canvas = browser.driver.find_element("css selector", "canvas").rect
    size = (round(canvas["width"]), round(canvas["height"]))
    whole = np.array(Image.fromarray(expected).resize(size))

    def alike():
        left, top = round(canvas["x"]), round(canvas["y"])
        seen = browser.picture()[top : top + size[1], left : left + size[0]]
        return np.abs(seen[60:400, 20:900].astype(int) - whole[60:400, 20:900]).mean() < 10

    wait(alike)
    choose(browser, "rendered", "points")


@pytest.mark.slow
def test_the_ply_is_downloaded(browser, viewer, small_run, tmp_path):
    browser.driver.execute_cdp_cmd(
        "Browser.setDownloadBehavior", {"behavior": "allow", "downloadPath": str(tmp_path)}
    )
    buttons = browser.driver.find_elements("css selector", "button")
    next(b for b in buttons if b.text == "Download PLY").click()
    path = tmp_path / "run.ply"
    wait(path.is_file)
    assert path.read_bytes() == (small_run / "memory.ply").read_bytes()


@pytest.mark.slow
def test_a_page_follows_a_run_that_grows(small_run, tmp_path):
    growing = tmp_path / "growing"
    shutil.copytree(small_run, growing)
    later = tmp_path / "later"
    (growing / "round_002").rename(later)
    source = ViewSource(growing)
    run = source.read()
    # As a run at work has it: the memory after the last whole round.
    run.memory.forget(round=2)
    run.memory.save(growing / "memory.npz")
    with served(source.read()) as viewer, open_browser() as browser:
        browser.driver.get(viewer.url)
        wait(lambda: "observations after round 1" in browser.text())
        assert "not finished: 1 of 2 rounds done" in browser.text()
        shutil.copy(small_run / "memory.npz", growing / "memory.npz")
        later.rename(growing / "round_002")
        viewer.update(source.read())
        wait(lambda: "observations after round 2" in browser.text())
        assert "not finished" not in browser.text()


def cloud(folder, scale):
    """A PLY of points in a box, ``scale`` units a metre, far from the world's origin."""
    where = np.random.default_rng(0).uniform(-0.5, 0.5, (4000, 3)) * (4, 5, 2) + (7, -3, 2)
    vertices = np.zeros(len(where), [*((a, "<f8") for a in "xyz"),
                                     *((c, "u1") for c in ("red", "green", "blue"))])  # fmt: skip
    for k, axis in enumerate("xyz"):
        vertices[axis] = scale * where[:, k]
    write_ply(folder / f"{scale:g}.ply", vertices)
    return ViewSource(folder / f"{scale:g}.ply").read()


def test_scenes_of_any_scale_are_the_same_on_the_page(tmp_path):
    sent = []
    for scale in (1.0, 1000.0, 0.001):
        with served(cloud(tmp_path, scale)) as viewer:
            start = viewer.server.initial_camera
            nodes = viewer._points._nodes.values()
            points = np.concatenate([node.points for node in nodes])
            assert start.near < np.linalg.norm(points - start.position, axis=1).min()
            assert start.far > np.linalg.norm(points - start.position, axis=1).max()
            sizes = [node.point_size for node in nodes]
            ends = (points.min(axis=0), points.max(axis=0), start.position, start.look_at, sizes)
            sent.append(np.concatenate(ends))
            # What a client sees goes back to the scene's own units.
            pose = camera(center=scale * np.array([7.0, -3.0, 1.0]), rotation=(0.1, 0.2, 0.3))
            wxyz, position = viewer.frame.placement(pose)
            seen = SimpleNamespace(
                wxyz=wxyz, position=position, fov=1.0, image_width=320, image_height=240
            )
            client: Any = SimpleNamespace(camera=seen)
            back = viewer.frame.client_camera(client, longest=320)
            np.testing.assert_allclose(back.cam_from_world, pose.cam_from_world, atol=1e-9 * scale)
    for other in sent[1:]:
        # The memory's voxels, not what is on the page, lie differently.
        np.testing.assert_allclose(other, sent[0], rtol=0.02, atol=0.06)


def test_of_two_cameras_selected_one_after_the_other_the_last_is_shown(small_run):
    run = ViewSource(small_run).read()
    slow, fast = run.cameras[3], run.cameras[4]
    asked, go_on = threading.Event(), threading.Event()

    def frame_of(name):
        if threading.current_thread().name == "first":
            asked.set()
            assert go_on.wait(PATIENCE)
        return run.frame_of(name)

    client = SimpleNamespace(
        client_id=0, atomic=nullcontext, flush=lambda: None,
        camera=SimpleNamespace(wxyz=np.array([1.0, 0, 0, 0]), position=np.zeros(3), fov=1.0),
    )  # fmt: skip
    with served(replace(run, cameras=(slow, fast), frame_of=frame_of)) as viewer:
        click = partial(viewer.select, clicked=True)
        try:
            first = threading.Thread(target=click, args=(slow, client), name="first")
            first.start()
            assert asked.wait(PATIENCE)
            second = threading.Thread(target=click, args=(fast, client))
            second.start()
            second.join()
            go_on.set()
            first.join()
            panel = viewer._panel
            assert fast.name in panel._camera.value and fast.name in panel._caption.content
            np.testing.assert_allclose(
                client.camera.position, viewer.frame.placement(fast.camera)[1], atol=1e-9
            )
        finally:
            go_on.set()


EVIL = '<img src=x onerror="window.stolen=1"><script>window.stolen=1</script>&amp;](x).png'


def test_names_of_files_are_shown_and_never_run(browser, viewer):
    before = viewer.run
    last = before.cameras[-1]
    try:
        viewer.update(replace(before, cameras=(*before.cameras[:-1], replace(last, name=EVIL))))
        label = f"{last.kind} {last.round}: {EVIL}"
        viewer._panel.set_note(EVIL)
        choose(browser, viewer._panel._camera.value, label)
        wait(lambda: f"{EVIL}, {TARGET}, round {last.round}" in browser.text())
        assert browser.driver.execute_script("return window.stolen") is None
        assert not browser.driver.find_elements("css selector", "img[src=x]")
    finally:
        viewer.update(before)


def on_screen(client, viewer, shown) -> tuple[float, float]:
    """Where the middle of a camera's frustum is in the canvas, CSS pixels."""
    seen = viewer.frame.client_camera(client, longest=LONGEST)
    pose = shown.camera.world_from_cam[0]
    inside = pose[:3, 3] + 0.9 * viewer.cameras._depth / viewer.frame.scale * pose[:3, 2]
    xy, z = seen.project(inside[None])
    assert z[0, 0] > 0
    scale = client.camera.image_width / seen.width[0]
    return tuple(xy[0, 0] * scale)


def click(browser: Browser, x: float, y: float) -> None:
    """Press and let go of the mouse at a place of the canvas."""
    box = browser.driver.find_element("css selector", "canvas").rect
    place = {"x": box["x"] + x, "y": box["y"] + y, "button": "left", "clickCount": 1}
    for kind in ("mouseMoved", "mousePressed", "mouseReleased"):
        browser.driver.execute_cdp_cmd("Input.dispatchMouseEvent", {"type": kind, **place})
        time.sleep(0.2)


def shown_picture(browser: Browser):
    """The picture in the panel as the page decoded it, (H, W, 3) uint8 in a tuple; or None."""
    script = """
        const image = [...document.images].find(i => i.naturalWidth > 700 && i.complete);
        if (!image) return null;
        const canvas = document.createElement("canvas");
        canvas.width = image.naturalWidth; canvas.height = image.naturalHeight;
        canvas.getContext("2d").drawImage(image, 0, 0);
        return canvas.toDataURL("image/png").split(",")[1];
    """
    data = browser.driver.execute_script(script)
    if data is None:
        return None
    return (np.array(Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB")),)


@pytest.mark.parametrize(
    "path",
    ["/run.json", "/../../../../../../../etc/hostname", "/%2e%2e/%2e%2e/%2e%2e/etc/hostname",
     "/..%2f..%2f..%2f..%2fetc%2fhostname", "//etc/hostname", "/etc/hostname",
     "/..\\..\\..\\etc\\hostname"],
)  # fmt: skip
def test_no_file_is_served_but_the_page(viewer, path):
    def get(address):
        connection = http.client.HTTPConnection("127.0.0.1", viewer.server.get_port(), timeout=20)
        connection.request("GET", address)
        return connection.getresponse()

    assert get("/").status == 200
    assert get(path).status == 404


def test_nobody_else_is_served_and_nothing_is_shared(viewer):
    assert viewer.url.startswith("http://127.0.0.1:")
    # A page may ask for an address in the open; it gets none.
    assert viewer.server.request_share_url() is None
    if sys.platform != "linux":
        pytest.skip("listening addresses are read from /proc")
    listening = {
        line.split()[1]
        for table in ("tcp", "tcp6")
        for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]
        if line.split()[1].endswith(f":{viewer.server.get_port():04X}") and line.split()[3] == "0A"
    }
    assert {address.split(":")[0] for address in listening} == {"0100007F"}


@pytest.mark.parametrize(
    ("origin", "status"),
    [("http://127.0.0.1:{port}", 101), (None, 101), ("http://evil.example", 403), ("null", 403),
     ("http://localhost:9", 101), ("http://evil.example:{port}", 403),
     ("http://localhost.evil.example", 403)],
)  # fmt: skip
def test_no_page_from_elsewhere_can_read_the_run(viewer, origin, status):
    assert handshake(viewer, origin) == status


def handshake(viewer, origin) -> int:
    """The status with which a request for a WebSocket is answered."""
    connection = http.client.HTTPConnection("127.0.0.1", viewer.server.get_port(), timeout=20)
    headers = {
        "Upgrade": "websocket", "Connection": "Upgrade",
        "Sec-WebSocket-Key": base64.b64encode(bytes(16)).decode(), "Sec-WebSocket-Version": "13",
    }  # fmt: skip
    if origin is not None:
        headers["Origin"] = origin.format(port=viewer.server.get_port())
    connection.request("GET", "/", headers=headers)
    status = connection.getresponse().status
    connection.close()
    return status


def test_on_other_addresses_the_page_itself_alone_may_read():
    for host in ("0.0.0.0", "box"):
        assert may_read("http://box:8080", "box:8080", host) and may_read(None, "box:8080", host)
        for origin in ("http://evil.example", "http://box:9090", "null", "http://localhost:8080"):
            assert not may_read(origin, "box:8080", host)


def test_addresses_are_written_and_judged_as_they_are():
    assert address_of("127.0.0.1", 8080) == "http://127.0.0.1:8080"
    assert address_of("::1", 9401) == "http://[::1]:9401"
    assert all(map(is_loopback, ("127.0.0.1", "127.0.0.2", "::1", "localhost")))
    assert not any(map(is_loopback, ("0.0.0.0", "::", "192.168.1.5", "box")))


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    scene = write_box(tmp_path_factory.mktemp("box"))
    return saved_run(scene, tmp_path_factory.mktemp("run") / "run", fitted=True)


@pytest.fixture(scope="module")
def splat_viewer(run):
    with served(ViewSource(run.folder).read()) as found:
        found.show_look(SPLATS)
        yield found


def get(splat_viewer, **headers):
    connection = http.client.HTTPConnection("127.0.0.1", splat_viewer.server.get_port(), timeout=20)
    connection.request("GET", splat_viewer._backdrop._address, headers=headers)
    return connection.getresponse()


def test_it_is_the_page_of_the_export(splat_viewer, run, tmp_path):
    export_run(run.folder, "html", tmp_path / "page.html")
    response = get(splat_viewer)
    assert response.getheader("Content-Type") == "text/html; charset=utf-8"
    served_, exported = (
        re.findall(r'class="splats".*', text)
        for text in (response.read().decode(), (tmp_path / "page.html").read_text("utf-8"))
    )
    # The fit counts as round 0; another round has its generated points.
    assert len(served_) == 2 and served_ == exported
    # Those of a round before are gone when there are new ones.
    before = splat_viewer._backdrop._address
    splat_viewer.update(splat_viewer.run)
    assert before != splat_viewer._backdrop._address and get(splat_viewer).status == 200


def test_nobody_else_can_read_it(splat_viewer):
    port = splat_viewer.server.get_port()
    assert get(splat_viewer, Host=f"localhost:{port}").status == 200
    # A name that its owner lets lead to this machine: browsers then send no Origin.
    assert get(splat_viewer, Host=f"evil.example:{port}").status == 403
    assert get(splat_viewer, Origin="http://evil.example").status == 403


@pytest.mark.slow
def test_a_browser_shows_what_the_run_does(splat_viewer, run, tmp_path):
    splat_viewer.cameras.set_kinds(dict.fromkeys(("context", "target"), False))
    # The fit alone.
    splat_viewer.show_round(0)
    with open_browser(width=700, height=400) as browser:
        browser.driver.get(splat_viewer.url)
        wait(lambda: "observations after round" in browser.text())
        close_notes(browser)
        client = wait(lambda: next(iter(splat_viewer.server.get_clients().values()), None))
        # Not the first, all of whose Gaussians are at one depth: their order is no matter.
        for shown in splat_viewer.run.cameras[1:]:
            wxyz, position = splat_viewer.frame.placement(shown.camera)
            client.camera.wxyz, client.camera.position = wxyz, position
            client.flush()
            wait(lambda p=position: np.linalg.norm(np.array(client.camera.position) - p) < 1e-3)
            camera = splat_viewer.frame.client_camera(client, longest=np.inf)
            expected = 255 * np.clip(run.appearance.picture(camera).rgb, 0, 1)
            height, width = expected.shape[:2]

            def alike(whole=expected, height=height, width=width):
                seen = browser.picture(tmp_path / "seen.png")[:height, :width].astype(float)
                return 10 * np.log10(255**2 / np.square(seen - whole).mean()) > 40

            wait(alike)
        splat_viewer.show_look(POINTS)
        wait(lambda: not browser.driver.find_elements("id", "splats"))
        splat_viewer.show_look(SPLATS)
        assert browser.console_errors() == [] and browser.foreign_requests() == []
