"""A memory step by step, in cells (``# %%``) for Jupyter, VS Code or Spyder; also a plain script.

python examples/08_memory_notebook.py [PROJECT [OUT]]
"""

# %% A project: views with cameras, pictures and depth
from __future__ import annotations

from sample import output_folder, sample_project

import gvtools

scene = gvtools.open_project(sample_project())
target = scene.views[len(scene) // 2]

# %% Round 0: fuse the first views
memory = gvtools.SpatialMemory(voxel=0.02)
for view in scene.views[:3]:
    frame = view.load()
    assert frame.depth is not None  # as of RGB-D; gvtools.reconstruct computes it otherwise
    memory.observe(frame.rgb, frame.depth, view.camera, round=0, mask=frame.mask)
print(memory)
print(f"known of {target.name}: {memory.project(target.camera).coverage:.1%}")

# %% Round 1: one more view
frame = scene.views[3].load()
assert frame.depth is not None
report = memory.observe(frame.rgb, frame.depth, scene.views[3].camera, round=1, mask=frame.mask)
print(f"{report.added:,} added, {report.merged:,} merged, {report.rejected:,} rejected")
print(f"known of {target.name}: {memory.project(target.camera).coverage:.1%}")

# %% Complete what is still unknown, and let the memory forget the round again
completion = gvtools.complete([], memory.project(target.camera), completer="inpaint")
print(f"completed: {(completion.depth > 0).mean():.1%}")
print(f"forgotten: {memory.forget(round=1):,} observations, rounds left: {memory.rounds}")

# %% Save it, and read it again
path = output_folder() / "notebook.npz"
memory.save(path)
assert len(gvtools.SpatialMemory.load(path)) == len(memory)
