"""The generative core on its own: one observed view, one unknown view, no memory and no run.

The core needs neither Open3D nor a run; its small model ships with the package.

python examples/07_core_alone.py [PROJECT [OUT]]
"""

from __future__ import annotations

import numpy as np
from PIL import Image
from sample import output_folder, sample_project

from gvtools import ContextView, Guidance, open_project
from gvtools.completers.geoverse.completer import GeoVerseCompleter

scene = open_project(sample_project())
first, second = scene.views[0], scene.views[1]
frame = first.load()
if frame.depth is None:
    raise SystemExit(f"{first.name} has no depth; expected a project with depth")
color = (frame.rgb / 255).astype(np.float32)
context = ContextView(first.name, first.camera, color, frame.depth)

# What the first view shows of the second one: each pixel lifted, and drawn as one pixel.
points = (first.camera.rays() * frame.depth[..., None])[frame.depth > 0]
points = points @ first.camera.world_from_cam[0, :3, :3].T + first.camera.centers[0]
xy, z = (values[0] for values in second.camera.project(points))
height, width = int(second.camera.height[0]), int(second.camera.width[0])
inside = (z > 0) & (xy >= 0).all(-1) & (xy < (width, height)).all(-1)
order = np.argsort(-z[inside])  # far to near: the nearest point is written last
x, y = xy[inside][order].astype(int).T
rgb, depth = np.zeros((1, height, width, 3), np.float32), np.zeros((1, height, width), np.float32)
rgb[0, y, x], depth[0, y, x] = color[frame.depth > 0][inside][order], z[inside][order]
known = depth > 0
guidance = Guidance(second.camera, rgb, depth, known, known.astype(np.float32), ~known & known)

completion = GeoVerseCompleter().complete([context], guidance, seed=0)
print(f"known {guidance.coverage:.1%}, depth afterwards {(completion.depth > 0).mean():.1%}")
picture = np.concatenate([rgb[0], completion.rgb[0], second.load().rgb / 255], axis=1)
path = output_folder() / "core.png"
Image.fromarray(np.rint(picture * 255).astype(np.uint8)).save(path)
print(f"known, completed, true: {path}")
