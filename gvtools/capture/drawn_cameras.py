"""Cameras as the demos of DUSt3R and MASt3R draw them into a .glb.

Each is a quad that shows the network's picture, and then a pyramid from its corners to the optical
centre. They tell pose and focal length; the principal point is the middle of the picture.
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras, Float64, concatenate, rigid_poses
from gvtools.glb import drawn_nodes, glb_numbers, split_glb
from gvtools.untrusted import PIXEL_BYTES, PIXEL_RATIO, open_picture, read_bytes

# A drawn camera's sides agree to this share: what is drawn is in float32.
EXACT = 1e-3
# Of a drawn point.
LEAST_BYTES = 12
# A point is one of a picture's pixels if its colour differs by no more [grey levels].
SAME = 4


def read_drawn_cameras(
    path: Path, *, most: int
) -> tuple[Cameras, NDArray[np.uint8], tuple[NDArray[np.int64], Float64, Float64]]:
    """V cameras, their (V, h, w, 3) pictures, and of ``most`` points view, place and position.

    ValueError where none are drawn with their pictures.
    """
    tree, body = split_glb(read_bytes(path))
    shapes: list[tuple[dict[str, Any], Float64]] = []
    count = 0
    for node, matrix in drawn_nodes(tree):
        for part in tree["meshes"][node["mesh"]]["primitives"] if "mesh" in node else ():
            local = glb_numbers(tree, body, part["attributes"]["POSITION"]).astype(np.float64)
            shapes.append((part, local @ matrix[:3, :3].T + matrix[:3, 3]))
            count += len(local)
            if count * LEAST_BYTES > len(body):
                raise ValueError("nodes that draw a mesh several times")
    drawn, pixels = list[tuple[Cameras, NDArray[np.uint8]]](), 0
    for quad, pyramid in pairwise(shapes):
        if "TEXCOORD_0" in quad[0]["attributes"] and len(quad[1]) == 4:
            drawn.append(_camera(quad, pyramid[1], tree=tree, body=body))
            pixels += drawn[-1][1].size
            if pixels > PIXEL_BYTES + PIXEL_RATIO * len(body):
                raise ValueError(f"pictures of {pixels} bytes in {len(body)}")
    if not drawn:
        raise ValueError("a scene to look at, in which no cameras are drawn with their pictures")
    cameras = concatenate([camera for camera, _ in drawn])
    pictures = np.stack([picture for _, picture in drawn])
    part, points = shapes[0]
    step = max(1, -(-len(points) // most))
    colored = part["attributes"].get("COLOR_0")
    colors = np.zeros((0, 3)) if colored is None else 255 * glb_numbers(tree, body, colored)[::step]
    points = points[::step][: len(colors)]
    view, xy = np.full(len(points), -1), np.zeros((len(points), 2))
    for row, (camera, picture) in enumerate(drawn):
        (place,), (z,) = camera.project(points)
        # Whether pixels' centres are at 0 or at 0.5.
        x, y = np.floor(place + 0.25).T
        seen = (z > 0) & (view < 0) & (x >= 0) & (y >= 0)
        seen &= (x < picture.shape[1]) & (y < picture.shape[0])
        shown = picture[y[seen].astype(int), x[seen].astype(int)]
        seen[seen] = np.abs(shown - colors[seen, :3]).max(axis=1) <= SAME
        view[seen], xy[seen] = row, place[seen]
    return cameras, pictures, (view[view >= 0], xy[view >= 0], points[view >= 0])


def _camera(
    quad: tuple[dict[str, Any], Float64], pyramid: Float64, *, tree: dict[str, Any], body: bytes
) -> tuple[Cameras, NDArray[np.uint8]]:
    """A drawn camera, and its picture."""
    part, corners = quad
    texture = tree["materials"][part["material"]]["pbrMetallicRoughness"]["baseColorTexture"]
    image = tree["images"][tree["textures"][texture["index"]]["source"]]
    view = tree["bufferViews"][image["bufferView"]]
    start = view.get("byteOffset", 0)
    with open_picture(body[start : start + view["byteLength"]]) as opened:
        picture = np.asarray(opened.convert("RGB"))
    height, width = picture.shape[:2]
    # Texture coordinates go right and down, from 0 to 1.
    uv = glb_numbers(tree, body, part["attributes"]["TEXCOORD_0"])
    along, down, corner = np.linalg.lstsq(np.column_stack([uv, np.ones(4)]), corners, rcond=None)[0]
    sides = np.linalg.norm([along, down], axis=1)
    x, y = along / sides[0], down / sides[1]
    ahead = np.cross(x, y)
    middle = corner + (along + down) / 2
    tip = pyramid[np.argmin((pyramid - middle) @ ahead)]
    distance = (middle - tip) @ ahead
    off = np.abs([x @ y, sides[0] / sides[1] * height / width - 1]).max()
    if not (off < EXACT and np.linalg.norm(middle - tip - distance * ahead) < EXACT * sides[1]):
        raise ValueError("a picture that no camera is drawn behind")
    rotation = np.array([x, y, ahead])
    pose = rigid_poses(rotation, -rotation @ tip)
    focal = float(distance / sides[1] * height)
    return Cameras.pinhole(width, height, focal=focal, cam_from_world=pose), picture
