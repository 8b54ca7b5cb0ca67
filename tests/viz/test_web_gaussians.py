"""The look "splats": the page to share, behind the web viewer's scene."""

from __future__ import annotations

import http.client
import re

import numpy as np
import pytest
from box_project import write_box
from browser import open_browser
from export_runs import export_run, saved_run
from web_page import close_notes, served, wait

from pipelines.viewing.source import ViewSource
from viz.viewer.run_view import POINTS, SPLATS


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    scene = write_box(tmp_path_factory.mktemp("box"))
    return saved_run(scene, tmp_path_factory.mktemp("run") / "run", fitted=True)


@pytest.fixture(scope="module")
def viewer(run):
    with served(ViewSource(run.folder).read()) as found:
        found._show_look(SPLATS)
        yield found


def get(viewer, **headers):
    connection = http.client.HTTPConnection("127.0.0.1", viewer.server.get_port(), timeout=20)
    connection.request("GET", viewer._backdrop._address, headers=headers)
    return connection.getresponse()


def test_it_is_the_page_of_the_export(viewer, run, tmp_path):
    export_run(run.folder, "html", tmp_path / "page.html")
    response = get(viewer)
    assert response.getheader("Content-Type") == "text/html; charset=utf-8"
    served_, exported = (
        re.findall(r'class="splats".*', text)
        for text in (response.read().decode(), (tmp_path / "page.html").read_text("utf-8"))
    )
    # The fit counts as round 0; another round has its generated points.
    assert len(served_) == 2 and served_ == exported
    # Those of a round before are gone when there are new ones.
    before = viewer._backdrop._address
    viewer.update(viewer.run)
    assert before != viewer._backdrop._address and get(viewer).status == 200


def test_nobody_else_can_read_it(viewer):
    port = viewer.server.get_port()
    assert get(viewer, Host=f"localhost:{port}").status == 200
    # A name that its owner lets lead to this machine: browsers then send no Origin.
    assert get(viewer, Host=f"evil.example:{port}").status == 403
    assert get(viewer, Origin="http://evil.example").status == 403


@pytest.mark.slow
def test_a_browser_shows_what_the_run_does(viewer, run, tmp_path):
    viewer._cameras.set_kinds(dict.fromkeys(("context", "target"), False))
    # The fit alone.
    viewer._show_round(0)
    with open_browser(width=700, height=400) as browser:
        browser.driver.get(viewer.url)
        wait(lambda: "observations after round" in browser.text())
        close_notes(browser)
        client = wait(lambda: next(iter(viewer.server.get_clients().values()), None))
        # Not the first, all of whose Gaussians are at one depth: their order is no matter.
        for shown in viewer.run.cameras[1:]:
            wxyz, position = viewer.frame.placement(shown.camera)
            client.camera.wxyz, client.camera.position = wxyz, position
            client.flush()
            wait(lambda p=position: np.linalg.norm(np.array(client.camera.position) - p) < 1e-3)
            camera = viewer.frame.client_camera(client, longest=np.inf)
            expected = 255 * np.clip(run.appearance.picture(camera).rgb, 0, 1)
            height, width = expected.shape[:2]

            def alike(whole=expected, height=height, width=width):
                seen = browser.picture(tmp_path / "seen.png")[:height, :width].astype(float)
                return 10 * np.log10(255**2 / np.square(seen - whole).mean()) > 40

            wait(alike)
        viewer._show_look(POINTS)
        wait(lambda: not browser.driver.find_elements("id", "splats"))
        viewer._show_look(SPLATS)
        assert browser.console_errors() == [] and browser.foreign_requests() == []
