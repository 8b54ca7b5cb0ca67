"""Meshes that ``gvtools view`` opens: what is large for a reason is read."""

from __future__ import annotations

from typing import Any

import numpy as np
from PIL import Image

from pipelines.viewing import readers

TRIANGLE = """mtllib m.mtl
usemtl a
v 0 0 0
v 1 0 0
v 0 1 0
vt 0 0
vt 1 0
vt 0 1
f 1/1 2/2 3/3
"""


def test_a_texture_is_measured_by_its_own_file(tmp_path, monkeypatch):
    monkeypatch.setattr(readers, "PIXEL_BYTES", 0)
    noise = np.random.default_rng(0).integers(0, 255, (256, 256, 3), np.uint8)
    Image.fromarray(noise).save(tmp_path / "t.png")
    (tmp_path / "m.mtl").write_text("newmtl a\nmap_Kd t.png\n")
    (tmp_path / "m.obj").write_text(TRIANGLE)
    before = Image.MAX_IMAGE_PIXELS
    mesh: Any = readers.load_mesh(tmp_path / "m.obj")
    assert mesh.visual.material.image.size == (256, 256)
    assert before == Image.MAX_IMAGE_PIXELS


def test_a_glb_of_more_than_a_million_points_opens(tmp_path):
    import trimesh

    points = np.random.default_rng(0).random((1_200_000, 3), np.float32)
    trimesh.PointCloud(points).export(tmp_path / "p.glb")
    assert len(readers.load_mesh(tmp_path / "p.glb").vertices) == 1_200_000
