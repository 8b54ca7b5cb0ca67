"""What each part of fitting and of judging depth is worth, one taken away at a time.

    python -m benchmarks.ablation SHARED OUT [--scenes "fox;kitchen"]

SHARED is the folder of real scenes. Fits go by steps, so that the figures do not depend on the
machine's other work. Results that OUT/*.json has already are not measured again; ``ablation.md`` is
the table: PSNR [dB] and SSIM of whole held-out pictures, and PSNR on pixels that the memory covers.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from contextlib import ExitStack
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any
from unittest.mock import patch

if TYPE_CHECKING:
    from pipelines.reconstruction.fitting import Fitted
    from pipelines.reconstruction.plan import Plan

# Project below SHARED/data, context, targets, steps. With seven photographs a fit converges after
# 560 steps, so that three are made; the others have one fit.
SCENES = {
    "fox": ("fox_colmap", "not:every:8", "every:8", 600),
    "fox, 7 views": ("fox_colmap", "every:8", "every:8+4", 1680),
    "kitchen": ("sevenscenes_reg", "every:2", "every:2+1", 300),
}
# Parts that a scene has no use for are not taken away there.
FEW_VIEWS = ("several fits", "dropout of Gaussians", "fading of opacities")
PHOTOGRAPHS = ("depth of the Gaussians (a plane sweep instead)",)
DEPTH = ("pose refinement", "depth in the loss", "check of depth by other views")
UNUSED = {
    "fox": (*FEW_VIEWS, *DEPTH),
    "fox, 7 views": DEPTH,
    "kitchen": (*FEW_VIEWS, *PHOTOGRAPHS, "smoothness of surfaces"),
}


def _with_swept_depth(fitted: Fitted, plan: Plan) -> Plan:
    """The plan with a fit's poses alone, so that photographs keep the plane sweep's depth."""
    return plan if fitted.poses is None else plan.at(fitted.poses)


def _as_completed(projected: Any, guidance: Any, rgb: Any) -> Any:
    """The completer's pictures as they are."""
    return rgb


# What is taken away: settings, and constants and functions by module and name.
PARTS: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "nothing (all parts)": ({}, {}),
    "fitting": ({"refine.steps": 0}, {}),
    "several fits": ({}, {"gvtools.appearance.fit.MOST_FITS": 1}),
    "exposures": ({"refine.exposure": False}, {}),
    "exposures of new cameras": (
        {},
        {"gvtools.appearance.camera_corrections.Exposures.shrinkage": 0.0},
    ),
    "smoothness of surfaces": ({}, {"gvtools.appearance.fit.SMOOTH": 0.0}),
    "dropout of Gaussians": ({}, {"gvtools.appearance.fit.LEFT_OUT": 0.0}),
    "fading of opacities": ({}, {"gvtools.appearance.fit.FADING": 0.0}),
    "depth of the Gaussians (a plane sweep instead)": (
        {},
        {"pipelines.reconstruction.fitting.Fitted.apply": _with_swept_depth},
    ),
    "pose refinement": ({"refine.poses": False}, {}),
    "depth in the loss": ({"refine.depth": 0.0}, {}),
    # More views than are asked.
    "check of depth by other views": ({}, {"gvtools.depth.source.LEAST": 255}),
    # The default, 0, keeps all.
    "completions of little confidence": ({"fusion.min_confidence": 0.35}, {}),
    "Gaussians' colours in holes": (
        {},
        {"pipelines.reconstruction.rounds.CachedProjection.colored": _as_completed},
    ),
}


def main() -> None:
    """Measure what is missing, then write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("shared", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--scenes", default=";".join(SCENES))
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    lines = ["| scene | without | PSNR | SSIM | PSNR, known pixels |", "|---|---|---|---|---|"]
    for scene in map(str.strip, args.scenes.split(";")):
        for part in [part for part in PARTS if part not in UNUSED[scene]]:
            file = args.out / f"{scene} {part}.json"
            if not file.exists():
                file.write_text(json.dumps(_measured(scene, part, args.shared, args.out)))
            found = json.loads(file.read_text())
            lines.append(
                f"| {scene} | {part} | {found['psnr']:.2f} | {found['ssim']:.3f} | "
                f"{found['psnr_valid']:.2f} |"
            )
            sys.stdout.write(lines[-1] + "\n")
            sys.stdout.flush()
    (args.out / "ablation.md").write_text("\n".join(lines) + "\n")


def _measured(scene: str, part: str, shared: Path, out: Path) -> dict[str, Any]:
    from gvtools import reconstruct

    project, context, targets, steps = SCENES[scene]
    settings, constants = PARTS[part]
    run = out / f"{scene} {part}".replace(" ", "_").replace(",", "")
    shutil.rmtree(run, ignore_errors=True)
    with ExitStack() as changes:
        for path, value in constants.items():
            holder, name = path.rsplit(".", 1)
            changes.enter_context(patch.object(_named(holder), name, value))
        reconstruct(
            shared / "data" / project, run, context=context, targets=targets,
            settings={"refine.steps": steps, **settings},
        )  # fmt: skip
    return json.loads((run / "metrics.json").read_text())


def _named(path: str) -> Any:
    """A module, or a class of one."""
    try:
        return import_module(path)
    except ModuleNotFoundError:
        module, name = path.rsplit(".", 1)
        return getattr(import_module(module), name)


if __name__ == "__main__":
    main()
