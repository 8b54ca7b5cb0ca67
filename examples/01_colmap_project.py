"""A COLMAP project: hold views out, grow a memory into them, and measure the result.

python examples/01_colmap_project.py [PROJECT [OUT]]
"""

from __future__ import annotations

import shutil

from sample import output_folder, sample_project

import gvtools

project, out = sample_project(), output_folder() / "colmap"
scene = gvtools.open_project(project)
print(f"{scene.kind}: {len(scene)} views, {sum(view.has_depth for view in scene)} with depth")
for finding in scene.findings:
    print(f"  {finding.level}: {finding.message}")

shutil.rmtree(out, ignore_errors=True)
run = gvtools.reconstruct(project, out, context="not:every:3", targets="every:3")
for report in run.reports:
    print(f"round {report['round']}: {report['points']:,} observations")

figures = gvtools.evaluate(run)
print(f"coverage {figures.coverage:.1%}, PSNR {figures.psnr:.2f} dB, SSIM {figures.ssim:.3f}")
print(f"memory and report: {run.path / 'memory.ply'}, {run.path / 'report.html'}")
