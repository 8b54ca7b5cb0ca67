"""``gvtools weights pack``: a trained model as it ships, with its training's record.

What a reader needs to judge and to repeat the training lies beside the weights: the settings of
each stage (``training_STAGE.json``) and its log, thinned (``log_STAGE.jsonl``).
"""

from __future__ import annotations

import json
from pathlib import Path

from gvtools.completers.geoverse.weights import (
    CONFIG_FILE,
    WHOLE_FILE,
    config_of,
    from_pretrained,
    save_pretrained,
)
from gvtools.errors import ProjectError
from gvtools.files import write_text
from gvtools.training.records import STAGES, read_log
from gvtools.training.run import SETTINGS, WEIGHTS
from gvtools.untrusted import read_json

# Records of a stage's log that are kept.
RECORDS = 150
DTYPE = "float16"


def pack(training: Path, out: Path) -> Path:
    """Write the last stage's weights and every stage's record.

    Args:
        training: folder of a ``gvtools train --out``.
        out: the folder to make or to renew; what else is in it stays.

    Returns:
        The stage's folder that the weights came from.
    """
    folders = [training / name / WEIGHTS for name in STAGES]
    finished = [folder for folder in folders if folder.is_dir() and config_of(folder).trained]
    if not finished:
        raise ProjectError(
            f"{training}: no finished denoiser; expected {training / 'denoiser' / WEIGHTS}; run "
            "gvtools train first"
        )
    if out.resolve().is_relative_to(training.resolve()):
        raise ProjectError(f"{out} lies within the training {training}; choose another folder")
    source = finished[-1]
    weights = [folder / WHOLE_FILE for folder in finished]
    newest = max(weights, key=lambda path: path.stat().st_mtime)
    if newest != weights[-1]:
        raise ProjectError(
            f"{source}: older than {newest.parent}, which an earlier stage made; run the later "
            "stage again, with its folder removed"
        )
    model = from_pretrained(source)
    out.mkdir(parents=True, exist_ok=True)
    save_pretrained(model, out, dtype=DTYPE)
    for stage in STAGES:
        for name in (f"log_{stage}.jsonl", f"training_{stage}.json"):
            (out / name).unlink(missing_ok=True)
        records = read_log(training / stage)
        if not records:
            continue
        step = max(1, len(records) // RECORDS)
        kept = [*records[:-1][::step], records[-1]]
        lines = (json.dumps({k: _short(v) for k, v in line.items()}) for line in kept)
        write_text(out / f"log_{stage}.jsonl", "\n".join(lines) + "\n")
        if (training / stage / SETTINGS).exists():
            settings = read_json(training / stage / SETTINGS)
            # Where its samples were kept is of no use elsewhere.
            settings["data"]["cache"] = None
            write_text(out / f"training_{stage}.json", json.dumps(settings, indent=2) + "\n")
    return source


def packed_bytes(folder: Path) -> int:
    """Of the model's own files."""
    return sum((folder / name).stat().st_size for name in (CONFIG_FILE, WHOLE_FILE))


def _short(value: float) -> float:
    return float(f"{value:.5g}")
