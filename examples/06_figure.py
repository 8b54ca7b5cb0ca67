"""A figure of a run: how the memory grew, and what was known and completed of one target.

python examples/06_figure.py [PROJECT [OUT]]
"""

from __future__ import annotations

import shutil

import matplotlib.pyplot as plt
from sample import output_folder, sample_project

import gvtools
from viz.plots.rounds import draw_growth

out = output_folder() / "figure"
shutil.rmtree(out, ignore_errors=True)
run = gvtools.reconstruct(
    sample_project(), out, context="not:every:3", targets="every:3", settings={"views_per_round": 2}
)
draw_growth(run.rounds, title="sample").savefig(out / "growth_again.png", dpi=120)

view, target, truth = next(run.targets())
before = plt.imread(view.folder / f"guidance_{view.report['stem']}.png")
pictures = {"known before": before, "completed": target.picture}
if truth is not None:
    pictures["held-out photograph"] = truth.load().rgb
figure, axes = plt.subplots(1, len(pictures), figsize=(4 * len(pictures), 3.4))
for axis, (title, picture) in zip(axes, pictures.items(), strict=True):
    axis.imshow(picture)
    axis.set_title(title)
    axis.axis("off")
figure.tight_layout()
figure.savefig(out / "target.png", dpi=120)
print(f"written: {out / 'growth_again.png'}, {out / 'target.png'}")
