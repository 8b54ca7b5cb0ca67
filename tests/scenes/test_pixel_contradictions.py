"""Pictures that are not what their cameras saw are said, and what would set them right."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from scenes_workspace import sparse_points

from gvtools.cameras import concatenate
from gvtools.scenes.inspection import inspect
from gvtools.scenes.pixel_contradictions import probed
from gvtools.scenes.scene import Frame, Scene, View


@pytest.fixture(scope="module")
def room(wall_walk):
    """A scene of eight views, and points of the first one's surface that the others show, too."""
    camera, depth = wall_walk[0].camera, wall_walk[0].depth
    x, y = (each.ravel() for each in np.meshgrid(*(np.arange(4, side, 8) for side in (160, 120))))
    local = (depth[..., None] * camera.rays())[y, x]
    pose = camera.world_from_cam[0]
    points = local @ pose[:3, :3].T + pose[:3, 3]
    xy, z = concatenate([view.camera for view in wall_walk[:8]]).project(points)
    view, point = np.nonzero((z > 0) & (xy > 1).all(axis=2) & (xy < (159, 119)).all(axis=2))
    sparse = sparse_points(points, point, view, xy[view, point])
    views = tuple(View(each.name, each.camera, partial(Frame, each.rgb)) for each in wall_walk[:8])
    return Scene(Path("walls"), "colmap", views, sparse)


def said(scene):
    return [f.message for f in inspect(scene).findings if "do not show" in f.message]


def showing(room, pictures):
    """The room with other pictures."""
    views = [
        replace(view, load=partial(Frame, np.ascontiguousarray(rgb)))
        for view, rgb in zip(room.views, pictures, strict=True)
    ]
    return replace(room, views=tuple(views))


def shifted(pictures):
    return [*pictures[1:], pictures[0]]


def cropped(pictures):
    return [
        cv2.resize(p[p.shape[0] // 6 : -p.shape[0] // 6, p.shape[1] // 6 : -p.shape[1] // 6],
                   p.shape[1::-1])
        for p in pictures
    ]  # fmt: skip


def test_right_pictures_are_believed(room):
    assert said(room) == [] and probed(room, room.names) == []


def seen_as(room, pictures, **points):
    """What is said of the room with other pictures, and points that differ."""
    scene = replace(showing(room, pictures), points=replace(room.points, **points))
    found = [f.message for f in inspect(scene).findings if f.level == "warning"]
    assert len(probed(scene, scene.names)) == len(found)
    return found


def test_pictures_that_are_all_a_little_off_are_said(room):
    pictures = [view.load().rgb for view in room]
    turn = cv2.getRotationMatrix2D((79.5, 59.5), 3, 1)
    for change, told in (
        (lambda p: np.roll(p, 5, axis=1), "shifted right by +3"),
        (lambda p: cv2.resize(p[3:-3, 4:-4], (160, 120)), "scaled by +"),
        (lambda p: cv2.resize(p[:, 5:-5], (160, 120)), "wider by +"),
        (lambda p: cv2.warpAffine(p, turn, (160, 120)), "turned by -0."),
    ):
        (line,) = seen_as(room, list(map(change, pictures)))
        assert told in line


@pytest.mark.parametrize("rows", [4, 8, 12])
def test_lamps_that_light_bands_are_no_contradiction(room, rows):
    pictures = [view.load().rgb for view in room]
    bands = [0.7 + 0.6 * ((np.arange(120) // rows + k) % 2) for k in range(len(pictures))]
    lit = [p * band[:, None, None] for p, band in zip(pictures, bands, strict=True)]
    assert seen_as(room, [np.clip(p, 0, 255).astype(np.uint8) for p in lit]) == []


def test_noisy_detections_of_corners_are_no_displacement(room):
    rng, points = np.random.default_rng(0), room.points
    smooth = cv2.GaussianBlur(rng.normal(0, 1, (120, 160)), (0, 0), 3)
    picture = 128 + 25 * smooth / smooth.std()
    x, y = (each.ravel() for each in np.meshgrid(np.arange(8, 152, 8), np.arange(8, 112, 7)))
    picture[y, x] += rng.normal(0, 100, len(x))
    rgb = np.repeat(np.clip(picture, 0, 255).astype(np.uint8)[..., None], 3, axis=2)
    xy = np.tile(np.stack([x, y], axis=1) + 0.5, (8, 1)) + rng.normal(0, 0.8, (8 * len(x), 2))
    index, view = np.tile(np.arange(len(x)), 8), np.repeat(np.arange(8), len(x))
    seen = replace(points, point_index=index, view_index=view, xy=xy)
    views = tuple(replace(view, load=partial(Frame, rgb)) for view in room.views)
    assert probed(replace(room, views=views, points=seen), room.names) == []


def test_swapped_channels_are_told_by_the_points_colours(room):
    greys = [view.load().rgb[..., 0] for view in room]
    pictures = [np.dstack([grey, grey, 255 - grey]) for grey in greys]
    first = room.points.rows_of_views(8)[0]
    colors = np.zeros_like(room.points.colors)
    x, y = room.points.xy[first].astype(int).T
    colors[room.points.point_index[first]] = pictures[0][y, x]
    assert seen_as(room, pictures, colors=colors) == []
    (line,) = seen_as(room, [p[..., ::-1] for p in pictures], colors=colors)
    assert "8 of 8 photographs have red and blue the other way round" in line


def test_depth_tells_where_there_are_no_tracks(room, wall_walk):
    for step, wrong in ((0, 0), (1, 1)):
        frames = [
            Frame(wall_walk[(i + step) % 8].rgb, wall_walk[i].depth.astype(np.float32))
            for i in range(8)
        ]
        views = [
            replace(view, load=partial(lambda frame: frame, frame), has_depth=True)
            for view, frame in zip(room.views, frames, strict=True)
        ]
        scene = replace(room, views=tuple(views), points=None)
        assert len(said(scene)) == wrong
        assert all("same places by depth" in line for line in said(scene))


def test_depth_of_views_far_apart_whose_poses_drift_tells_nothing(room, wall_walk):
    views = []
    for number in (0, 4, 8):
        seen = wall_walk[number]
        pose = seen.camera.cam_from_world.copy()
        pose[0, :3, 3] += (0.02 * number, -0.015 * number, 0)
        camera = replace(seen.camera, cam_from_world=pose)
        frame = Frame(seen.rgb, seen.depth.astype(np.float32))
        views.append(View(seen.name, camera, partial(lambda frame: frame, frame), has_depth=True))
    assert not said(replace(room, views=tuple(views), points=None))


def test_two_swapped_pictures_are_named_alone(room):
    rgb = [view.load().rgb for view in room]
    rgb[0], rgb[7] = rgb[7], rgb[0]
    assert "2 of 8 photographs" in said(showing(room, rgb))[0]


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (shifted, "each fits the picture before it"),
        (cropped, ""),
        (lambda pictures: [p[:, ::-1] for p in pictures], "they fit mirrored left to right"),
        (lambda pictures: [p[::-1, ::-1] for p in pictures], "they fit turned by half"),
        (lambda pictures: [*pictures[:-1], pictures[-1][::-1]], "they fit turned upside down"),
    ],
)
def test_wrong_pictures_are_said_with_their_reason(room, change, reason):
    scene = showing(room, change([view.load().rgb for view in room]))
    (message,) = said(scene)
    assert reason in message
    wrong = 1 if "upside" in reason else 8
    assert f"{wrong} of 8 photographs" in message
    assert probed(scene, scene.names)
