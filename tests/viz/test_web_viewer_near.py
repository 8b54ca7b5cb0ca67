"""All observations near the viewer's camera, in place of coarse points: what is sent, and seen."""

from __future__ import annotations

import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from browser import open_browser
from memory_scenes import camera
from test_web_viewer import choose, close_notes, free_port, steady, wait

from gvtools.memory.spatial_memory import SpatialMemory
from pipelines.inputs.view_source import ViewSource

pytest.importorskip("viser", reason="viser is not installed (extra web)")

import viser

from viz.web import near as web_viewer_near
from viz.web.near import NEAR_SHARE
from viz.web.viewer import WebViewer

# In front of what the two rounds completed.
BETWEEN = camera(center=(1.95, 0.0, 2.7))
# Of the whole run; less than half of its observations.
BUDGET = 2000


@pytest.fixture(scope="module")
def run(small_run):
    return ViewSource(small_run).read()


@pytest.fixture
def viewer(run):
    found = WebViewer(run, port=free_port(), budget=BUDGET)
    yield found
    found.stop()


class Client:
    """Someone who looks at a viewer, without a browser; its scene tells what was sent."""

    def __init__(self, viewer, number=0):
        self.viewer = viewer
        self.client_id = number
        self.server = viser.ViserServer(port=free_port(), verbose=False)
        self.scene, self.gui, self.atomic = self.server.scene, self.server.gui, self.server.atomic
        self.camera = SimpleNamespace(fov=1.2, image_width=320, image_height=240)
        viewer.server.get_clients = lambda: {number: self}

    def go(self, pose, ahead=0.0, turn=0.0):
        """Stand where a camera of the project stands, or ``ahead`` of it, turned by radians."""
        wxyz, at = self.viewer.frame.placement(pose)
        turned = viser.transforms.SO3.from_y_radians(turn)
        self.camera.wxyz = (viser.transforms.SO3(np.asarray(wxyz)) @ turned).wxyz
        way = pose.world_from_cam[0, :3, 2]
        self.camera.position = at + ahead * self.viewer.frame.scale * way
        self.viewer._near.moved(self)

    def nodes(self):
        """What the client has of its own, by chunk and round."""
        chunks = self.viewer._near._drawn.get(self.client_id, {})
        return {(c, r): node for c, chunk in chunks.items() for r, node in chunk.nodes.items()}

    def rows(self):
        chunks = self.viewer._near._drawn.get(self.client_id, {})
        return np.concatenate([[], *(chunk.rows for chunk in chunks.values())]).astype(int)

    def settled(self):
        """The nodes once nothing more comes."""
        near = self.viewer._near

        def still():
            before = self.nodes()
            time.sleep(0.3)
            return before and not near._due and self.nodes() == before and (before,)

        return wait(still)[0]


@pytest.fixture
def client(viewer):
    found = Client(viewer)
    yield found
    found.server.stop()


def test_every_observation_near_the_camera_is_sent_in_place_of_the_coarse_ones(client, viewer, run):
    client.go(run.cameras[0].camera)
    assert not client.rows().size, "nothing before the camera stands still"
    nodes = client.settled()
    rows, memory = client.rows(), run.memory
    assert len(memory) > BUDGET
    assert 0 < len(rows) == len(set(rows.tolist())) <= NEAR_SHARE * BUDGET
    chunks = {chunk for chunk, _ in nodes}
    # Whole chunks: all of their observations, with the coarse points among them.
    number = viewer._chunks.number(memory, np.arange(len(memory)))
    assert set(rows.tolist()) == set(np.flatnonzero(np.isin(number, list(chunks))).tolist())
    coarse = viewer._points.rows[np.isin(number[viewer._points.rows], list(chunks))]
    assert set(coarse.tolist()) < set(rows.tolist())
    assert viewer._near.drawn(client, 9) == (len(rows), chunks)
    assert viewer._points.drawn(9, chunks) == len(coarse)
    content = viewer._panel._near[0].content
    assert f"all {len(rows):,} observations, in place of {len(coarse):,} points" in content
    # Under the coarse nodes' own names, where and in the colours that they are.
    names = {handle.name for handle in viewer._points._nodes.values()}
    assert {nodes[key].name for key in nodes if key in viewer._points._nodes} <= names
    assert chunks <= {chunk for chunk, _ in viewer._points._nodes}
    of = viewer._near._drawn[0]
    for chunk, found in of.items():
        for round, places in found.places.items():
            node, mine = nodes[chunk, round], found.rows[places]
            assert (run.round_of_points()[mine] == round).all()
            expected = viewer.frame.points(memory.columns.positions[mine])
            # To a hundredth of a point's size.
            np.testing.assert_allclose(
                node.points.astype(np.float32) + node.position, expected, atol=node.point_size / 100
            )
            np.testing.assert_array_equal(node.colors, memory.columns.colors[mine])
            assert node.points.nbytes + node.colors.nbytes == 9 * len(mine)
    assert {node.point_size for node in nodes.values()} <= {
        viewer.frame.scale * float(s) for s in np.unique(memory.columns.spacing[: len(memory)])
    }
    assert max(node.point_size for node in nodes.values()) < viewer._points._point_size()


def test_rounds_colours_size_and_look_hold_for_near_points(client, viewer, run):
    client.go(BETWEEN)
    nodes = client.settled()
    assert len({round for _, round in nodes}) > 1
    for number in (0, 2, 1):
        viewer._panel._round.value = number
        viewer._show_round(number)
        assert all(node.visible == (round <= number) for (_, round), node in nodes.items())
        rounds = run.round_of_points()[client.rows()]
        shown = int((rounds <= number).sum())
        assert viewer._near.drawn(client, number)[0] == shown
        assert f"all {shown:,} observations" in viewer._panel._near[0].content
    viewer._show_look(True)
    assert not any(node.visible for node in nodes.values())
    viewer._show_look(False)
    wait(lambda: not viewer._near._due)
    assert any(node.visible for node in nodes.values())
    before = {key: node.point_size for key, node in nodes.items()}
    viewer._set_size(0.5)
    assert all(node.point_size == pytest.approx(before[k] / 2) for k, node in nodes.items())
    for mode in ("views", "source", "color"):
        viewer._panel._mode.value = viewer._panel._mode.options[
            ["color", "round", "source", "confidence", "views", "depth-error"].index(mode)
        ]
        viewer._show_mode(mode)
        of = viewer._near._drawn[0]
        for chunk in of.values():
            whole = run.colors(mode, chunk.rows).rgb

            def alike(chunk=chunk, whole=whole):
                return all(
                    np.array_equal(node.colors, whole[chunk.places[round]])
                    for round, node in chunk.nodes.items()
                )

            wait(alike)
        # The points themselves are not sent again.
        assert client.nodes() == nodes


def test_moving_on_sends_what_is_new_alone_and_takes_back_what_is_out_of_view(
    client, viewer, run, monkeypatch
):
    # Longer than a busy machine stands still.
    monkeypatch.setattr(web_viewer_near, "REST_SECONDS", 1.5)
    client.go(run.cameras[0].camera)
    first = client.settled()
    for _ in range(9):  # As long as it moves, what was there stays.
        client.go(run.cameras[0].camera, ahead=0.4 * run.typical_depth, turn=-0.3)
        time.sleep(0.25)
        assert client.nodes() == first
    wait(lambda: client.nodes().keys() != first.keys())
    second = client.settled()
    kept = first.keys() & second.keys()
    assert kept and all(first[key] is second[key] for key in kept)
    assert second.keys() - first.keys() and first.keys() - second.keys()
    client.camera.wxyz = viser.transforms.SO3.from_y_radians(np.pi).wxyz
    viewer._near.moved(client)
    wait(lambda: not client.nodes())
    assert all(node._impl.removed for node in second.values())
    wait(lambda: not viewer._panel._near[0].visible)


def test_a_move_meanwhile_is_answered_instead(client, viewer, run):
    sent, go_on = [], []
    original = viewer._near._colors

    def slow(shown, mode, rows):
        sent.append(len(rows))
        if len(sent) == 1:
            client.go(run.cameras[-1].camera)
            go_on.append(client.nodes())
        return original(shown, mode, rows)

    viewer._near._colors = slow
    client.go(run.cameras[0].camera)
    wait(lambda: len(sent) == 2)
    client.settled()
    assert go_on == [{}]
    table_first, wanted = sent[0], client.rows()
    viewer._near._colors = original
    other = Client(viewer, number=1)
    try:
        other.go(run.cameras[-1].camera)
        other.settled()
        # Nothing is left of the first place.
        assert sorted(other.rows().tolist()) == sorted(wanted.tolist())
        assert table_first > 0
    finally:
        other.server.stop()


def test_a_run_that_grows_is_drawn_as_it_is_by_now(small_run, run):
    earlier = SpatialMemory.load(small_run / "memory.npz")
    earlier.forget(round=2)
    before = replace(run, memory=earlier, reports=run.reports[:2])
    viewer = WebViewer(before, port=free_port(), budget=BUDGET)
    client = Client(viewer)
    try:
        client.go(BETWEEN)
        assert 2 not in {round for _, round in client.settled()}
        viewer.update(run)
        wait(lambda: 2 in {round for _, round in client.nodes()})
        client.settled()
        chunks = {chunk for chunk, _ in client.nodes()}
        assert viewer._chunks is not None
        number = viewer._chunks.number(run.memory, np.arange(len(run.memory)))
        expected = np.flatnonzero(np.isin(number, list(chunks)))
        assert sorted(client.rows().tolist()) == expected.tolist()
        assert all(node.visible for node in client.nodes().values())
    finally:
        viewer.stop()
        client.server.stop()


def test_a_run_within_the_budget_is_drawn_whole_and_nothing_is_sent_twice(run):
    viewer = WebViewer(run, port=free_port(), budget=len(run.memory))
    client = Client(viewer)
    try:
        assert viewer._points.drawn(2) == len(run.memory) and len(viewer._points._nodes) == 3
        client.go(run.cameras[0].camera)
        assert viewer._near._source is None and not viewer._near._due
    finally:
        viewer.stop()
        client.server.stop()


@pytest.mark.slow
def test_who_flies_near_sees_more(run, viewer):
    full = WebViewer(run, port=free_port())
    # Close enough that all that is in view is within the budget: a coarse point beside near ones
    # is as far as they are, and which of them covers which is decided by who came last.
    shown = run.cameras[1]
    with open_browser() as browser:

        def look_from_there(of, **options):
            client = wait(lambda: next(iter(of.server.get_clients().values()), None))
            wxyz, position = of.frame.placement(shown.camera)
            way = of.frame.scale * shown.camera.world_from_cam[0, :3, 2]
            ahead = 0.88 * run.typical_depth * way
            with client.atomic():
                client.camera.wxyz, client.camera.position = wxyz, position + ahead
            client.flush()
            return client

        try:
            browser.driver.get(viewer.url)
            wait(lambda: "near you all" in browser.text())
            close_notes(browser)
            viewer._near.set_source(None)
            look_from_there(viewer)
            coarse = steady(browser)
            viewer._set_near()
            client = look_from_there(viewer)
            fine = steady(browser, coarse)
            near, chunks = viewer._near.drawn(client, 2)
            assert near > viewer._points.drawn(2, chunks) > 0
            assert f"near you all {near:,} observations" in browser.text()
            choose(browser, "colour", "observed / generated")
            tinted = steady(browser, fine)
            assert browser.console_errors() == [] and browser.foreign_requests() == []
            browser.driver.get(full.url)
            wait(lambda: "observations after round 2" in browser.text())
            close_notes(browser)
            look_from_there(full)
            whole = steady(browser)
            choose(browser, "colour", "observed / generated")
            whole_tinted = steady(browser, whole)
        finally:
            full.stop()

    def share(one, other):
        return (np.abs(one.astype(int) - other).max(axis=2) > 2).mean()

    # As if everything were drawn; coarse points are not.
    assert share(coarse, whole) > 0.3
    assert share(fine, whole) < 0.02 and share(tinted, whole_tinted) < 0.02
