"""A scan (posed RGB-D): build the memory frame by frame and look from where nobody stood.

python examples/02_scan.py [PROJECT [OUT]]
"""

from __future__ import annotations

import numpy as np
from PIL import Image
from sample import output_folder, sample_project

import gvtools

scene = gvtools.open_project(sample_project())
seen, hidden = scene.views[::2], scene.views[1::2]
memory = gvtools.SpatialMemory(voxel=0.02)
for view in seen:
    frame = view.load()
    if frame.depth is None:
        continue  # gvtools.reconstruct computes depth where there is none
    report = memory.observe(frame.rgb, frame.depth, view.camera, round=0, mask=frame.mask)
    print(f"{view.name}: {report.added:,} added, {report.merged:,} merged")
print(memory)

for view in hidden:
    guidance = memory.project(view.camera)
    valid, truth = guidance.valid[0], view.load().rgb / 255
    psnr = -10 * np.log10(np.mean((guidance.rgb[0] - truth)[valid] ** 2))
    print(f"{view.name}: {guidance.coverage:.1%} known, PSNR there {psnr:.1f} dB")

picture = output_folder() / "hidden_view.png"
Image.fromarray(np.rint(guidance.rgb[0] * 255).astype(np.uint8)).save(picture)
memory.save(picture.with_name("memory.npz"))
print(f"the last view as the memory knows it: {picture}")
