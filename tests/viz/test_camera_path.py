from __future__ import annotations

import json
from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from memory_scenes import camera
from web_page import served

from gvtools.errors import DegenerateError, OptionError
from gvtools.memory.spatial_memory import SpatialMemory
from pipelines.cli import main
from pipelines.rendering import film_cameras
from pipelines.viewing.source import ViewSource
from viz.viewer.camera_path import FRAMES
from viz.viewer.nodes import vertical_field_of_view
from viz.viewer.web import WebViewer


class Client:
    """A page that stands somewhere, and what it was told."""

    def __init__(self, viewer: WebViewer) -> None:
        self.client_id = 0
        self._viewer = viewer
        self.camera: Any = SimpleNamespace(
            wxyz=np.array([1.0, 0, 0, 0]), position=np.zeros(3), fov=1.0,
            image_width=800, image_height=600,
        )  # fmt: skip
        self.notes: list[tuple[str, str]] = []
        self.sent: dict[str, bytes] = {}
        self.seen: list[np.ndarray] = []
        self.atomic = nullcontext

    def stand(self, pose, fov: float = 1.0) -> None:
        self.camera.wxyz, self.camera.position = self._viewer.frame.placement(pose)
        self.camera.fov = fov

    def flush(self) -> None:
        self.seen.append(np.array(self.camera.position))

    def add_notification(self, title: str, body: str, **_: object) -> None:
        self.notes.append((title, body))

    def send_file_download(self, name: str, content: bytes, **_: object) -> None:
        self.sent[name] = content


@pytest.fixture
def folder(small_run, tmp_path):
    """The run's memory in a folder of its own."""
    (tmp_path / "memory.npz").write_bytes((small_run / "memory.npz").read_bytes())
    return tmp_path


@pytest.fixture
def viewer(folder):
    with served(ViewSource(folder).read()) as found:
        yield found


POSES = [
    camera(center=(0.3 * k, 0.1 * k * k, 0.0), rotation=(0.0, 0.1 * k, 0.02)) for k in range(3)
]


def with_keys(viewer: WebViewer, poses=POSES, fov: float = 1.0) -> Any:
    client: Any = Client(viewer)
    for pose in poses:
        client.stand(pose, fov)
        viewer.path.add(client)
    return client


def test_a_saved_path_is_a_film_through_its_key_frames(viewer, folder):
    client = with_keys(viewer, fov=0.9)
    path = viewer.path.save(client)
    assert path == folder / "paths" / "path.json"
    assert client.notes == [("Saved", f"gvtools film {folder} --path {path}")]
    memory = SpatialMemory.load(folder / "memory.npz")
    cameras = film_cameras(memory, str(path))
    assert len(cameras) == FRAMES
    first = viewer.run.cameras[0].camera
    assert (cameras.width == first.width[0]).all() and (cameras.height == first.height[0]).all()
    np.testing.assert_allclose(vertical_field_of_view(cameras[0]), 0.9, atol=1e-9)
    for pose in POSES:
        away = np.linalg.norm(cameras.centers - pose.centers[0], axis=1)
        nearest = int(away.argmin())
        # Between two frames at most, and exactly there at both ends.
        assert away[nearest] < np.linalg.norm(np.diff(cameras.centers, axis=0), axis=1).max()
    for row, pose in ((0, POSES[0]), (-1, POSES[-1])):
        np.testing.assert_allclose(cameras.cam_from_world[row], pose.cam_from_world[0], atol=1e-9)


def test_film_draws_a_saved_path(viewer, folder):
    client = with_keys(viewer, POSES[:2])
    viewer.path._frames.value = 3
    path = viewer.path.save(client)
    out = folder / "film.gif"
    assert main(["film", str(folder), "--path", str(path), "--out", str(out), "--quiet"]) == 0
    assert out.stat().st_size > 1000
    assert len(film_cameras(SpatialMemory.load(folder / "memory.npz"), f"{path}@first:2")) == 2


def test_the_last_key_frame_is_taken_back(viewer):
    client = with_keys(viewer)
    assert "3 key frames" in viewer.path._status.content
    viewer.path.remove_last()
    np.testing.assert_allclose(viewer.path.cameras(2).centers[1], POSES[1].centers[0], atol=1e-9)
    for _ in range(3):
        viewer.path.remove_last()
    assert "no key frames" in viewer.path._status.content
    assert not viewer.path._nodes
    with pytest.raises(OptionError, match="2 or more"):
        viewer.path.save(client)


def test_key_frames_and_their_line_are_on_the_page(viewer):
    with_keys(viewer)
    *keys, line = viewer.path._nodes
    for pose, node in zip(POSES, keys, strict=True):
        np.testing.assert_allclose(node.position, viewer.frame.placement(pose)[1], atol=1e-9)
    ends = line.points.reshape(-1, 3)[[0, -1]]
    expected = [viewer.frame.placement(POSES[k])[1] for k in (0, -1)]
    np.testing.assert_allclose(ends, expected, atol=1e-5)


@pytest.mark.parametrize(
    "name", ["", "../up", "a/b", "a\\b", ".hidden", "a.b", "x" * 65, "é", "a\n"]
)
def test_names_that_could_lead_elsewhere_are_refused(viewer, folder, name):
    client = with_keys(viewer)
    viewer.path._name.value = name
    with pytest.raises(OptionError, match="letters"):
        viewer.path.save(client)
    assert not (folder / "paths").exists()


def test_a_path_replaces_a_path_and_nothing_else(viewer, folder):
    client = with_keys(viewer)
    first = viewer.path.save(client).read_bytes()
    viewer.path.remove_last()
    assert viewer.path.save(client).read_bytes() != first
    path = folder / "paths" / "path.json"
    path.write_text('{"mine": true}')
    with pytest.raises(OptionError, match="no path"):
        viewer.path.save(client)
    assert path.read_text() == '{"mine": true}'


def test_key_frames_at_one_place_are_no_path(viewer):
    client = with_keys(viewer, [POSES[0], POSES[0]])
    with pytest.raises(DegenerateError):
        viewer.path.save(client)


def test_pages_from_elsewhere_get_the_file_and_write_nothing(folder):
    with served(ViewSource(folder).read(), host="0.0.0.0") as viewer:
        client = with_keys(viewer)
        assert viewer.path.save(client) is None
        frames = json.loads(client.sent["path.json"])["frames"]
        assert len(frames) == FRAMES and frames[1]["file_path"] == "path/00001.png"
        assert not (folder / "paths").exists()


def test_a_second_click_stops_the_preview(viewer):
    client = with_keys(viewer)
    plain = client.flush

    def flush() -> None:
        plain()
        assert not any(node.visible for node in viewer.path._nodes)
        if len(client.seen) == 3:
            viewer.path.preview(client)

    client.flush = flush
    viewer.path.preview(client)
    assert len(client.seen) == 3
    viewer.path._frames.value = 2
    client.flush = plain
    viewer.path.preview(client)
    assert len(client.seen) == 5
