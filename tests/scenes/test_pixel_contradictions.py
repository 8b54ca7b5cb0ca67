"""Pictures that are not what their cameras saw are said, and what would set them right."""

from __future__ import annotations

import shutil

import cv2
import numpy as np
import pytest

from gvtools.procedural.room_sample import write_room
from gvtools.scenes.inspection import inspect
from gvtools.scenes.pixel_contradictions import probed
from gvtools.scenes.project import open_project


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    folder = tmp_path_factory.mktemp("room") / "room"
    write_room(folder, views=8)
    return folder


def said(folder):
    return [f.message for f in inspect(open_project(folder)).findings if "do not show" in f.message]


def shifted(pictures):
    return [*pictures[1:], pictures[0]]


def cropped(pictures):
    return [
        cv2.resize(p[p.shape[0] // 6 : -p.shape[0] // 6, p.shape[1] // 6 : -p.shape[1] // 6],
                   p.shape[1::-1])
        for p in pictures
    ]  # fmt: skip


def test_right_pictures_are_believed(room):
    assert said(room) == [] and probed(open_project(room), open_project(room).names) == []


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
def test_wrong_pictures_are_said_with_their_reason(room, tmp_path, change, reason):
    folder = tmp_path / "room"
    shutil.copytree(room, folder)
    files = sorted(path for path in (folder / "images").iterdir())
    pictures = change([cv2.imread(str(file)) for file in files])
    for file, picture in zip(files, pictures, strict=True):
        cv2.imwrite(str(file), np.ascontiguousarray(picture))
    (message,) = said(folder)
    assert reason in message
    scene = open_project(folder)
    wrong = 1 if "upside" in reason else 8
    assert f"{wrong} of 8 photographs" in message
    assert probed(scene, scene.names)
