"""What each departure from the paper's protocol does to the pictures.

    python benchmarks/protocol.py PROJECT CONTEXT TARGETS OUT [--weights DIR]

Runs ``gvtools reconstruct`` with the completer ``geoverse`` as it is by default, but for the fit of
Gaussians, then with more and more of the settings of ``--protocol paper``, then with all of them.
Prints a Markdown table of the completed held-out pictures; runs that are in OUT are not made again.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path

from pipelines.reconstruction.settings import PAPER

ALWAYS = ("completer=geoverse", "refine.steps=0")
ALWAYS_SET = [text.partition("=")[0] for text in ALWAYS]
DECODED = ("completer.composition",)
UNALIGNED = (*DECODED, "completer.alignment", "completer.color_alignment")
WHOLE = (*UNALIGNED, "completer.output", "effort.inpaint_below")
# Of the first part each row adds to the one above it.
GROUPS = {
    "as gvtools does, without fitting Gaussians": (),
    "decoded pictures, not corrections of filled projections": DECODED,
    "and scale by camera centres, colours not aligned with the memory's": UNALIGNED,
    "and whole views as output, also of views with small holes": WHOLE,
    "and all of their pixels fused": (*WHOLE, "fusion.pixels"),
    "and fused like observed ones": (*WHOLE, "fusion.pixels", "fusion.generated_as_observed"),
    "only this, from the first row: all shortcuts that save time or memory off": (
        "fusion.max_psnr_drop_db",
        "savings.reuse",
        "savings.pixel_binning",
        "savings.depth_from_memory",
        "memory.voxels_per_footprint",
        "memory.merge_angle_deg",
        "memory.observations_per_voxel",
    ),
    "only this, from the first row: recorded poses as given": ("refine.poses",),
    "all of --protocol paper": tuple(key for key in PAPER if key not in ALWAYS_SET),
}


def main() -> None:
    """Run what is missing and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("project", type=Path)
    parser.add_argument("context")
    parser.add_argument("targets")
    parser.add_argument("out", type=Path)
    parser.add_argument("--weights", type=Path)
    args = parser.parse_args()
    print("| variant | PSNR | SSIM | PSNR, generated | seconds |")
    print("|---|---|---|---|---|")
    for number, (name, keys) in enumerate(GROUPS.items()):
        run = args.out / str(number)
        if not (run / "metrics.json").exists():
            words = ["reconstruct", str(args.project), "--out", str(run), "--quiet"]
            words += ["--context", args.context, "--targets", args.targets]
            texts = [*ALWAYS, *(f"{key}={_text(PAPER[key])}" for key in keys)]
            texts += [f"completer.weights={args.weights}"] if args.weights else []
            words += [word for text in texts for word in ("--set", text)]
            subprocess.run([sys.executable, "-m", "pipelines.cli", *words], check=True)
        found = json.loads((run / "metrics.json").read_text())
        rounds = (run / "rounds.jsonl").read_text().splitlines()
        seconds = sum(json.loads(line)["seconds"]["total"] for line in rounds)
        shown = [f"{found[key]:.2f}" for key in ("psnr", "ssim", "psnr_generated")]
        print(f"| {name} | {' | '.join(shown)} | {seconds:.0f} |", flush=True)


def _text(value: object) -> str:
    return "none" if value is None else str(value).lower()


if __name__ == "__main__":
    main()
