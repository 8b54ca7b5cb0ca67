"""Each departure from the paper's protocol, switched to the paper's way by itself.

    python benchmarks/protocol.py PROJECT CONTEXT TARGETS OUT [--weights DIR]

Runs ``gvtools reconstruct`` with the completer ``geoverse`` as it is by default, but for the fit of
Gaussians, then with one group of settings of ``--protocol paper`` at a time, then with all of them.
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
GROUPS = {
    "as gvtools does, without a fit": (),
    "decoded pictures, not corrections of filled projections": ("completer.composition",),
    "scale by camera centres, colours not aligned": (
        "completer.composition",
        "completer.alignment",
        "completer.color_alignment",
    ),
    "whole views as output": ("completer.output",),
    "whole views, all pixels fused": ("completer.output", "fusion.pixels"),
    "whole views, fused like observed ones": (
        "completer.output",
        "fusion.pixels",
        "fusion.generated_as_observed",
    ),
    "views with small holes are not left to inpaint": ("effort.inpaint_below",),
    "nothing saved in memory and projection": (
        "fusion.max_psnr_drop_db",
        "savings.reuse",
        "savings.pixel_binning",
        "savings.depth_from_memory",
        "memory.voxels_per_footprint",
    ),
    "trackers' poses as given": ("refine.poses",),
    "all of these": tuple(key for key in PAPER if key not in ("completer", "refine.steps")),
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
    print("| the paper's way | PSNR | SSIM | PSNR, generated | seconds |")
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
