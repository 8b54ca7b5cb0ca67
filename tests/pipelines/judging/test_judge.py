"""``gvtools judge`` on pictures of a tiny recording."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
from command_line import refused
from PIL import Image

from gvtools.evaluation.images import psnr
from gvtools.evaluation.view_figures import FIGURES
from gvtools.runs.run import load_run
from pipelines.cli import main


def judge(*arguments: object) -> None:
    assert main(["judge", *map(str, arguments), "--quiet"]) == 0


def read(out) -> dict:
    return json.loads((out / "judge.json").read_text())


def truths(run) -> dict[str, np.ndarray]:
    """The true pictures of a run's targets by name."""
    return {files.name: truth.load().rgb for _, files, truth in load_run(run).targets()}


def write_pictures(folder, pictures) -> None:
    for name, rgb in pictures.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(rgb).save(path)


def noisy(run, seed: int, sigma: float = 8.0) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    return {
        name: np.clip(rgb + rng.normal(0, sigma, rgb.shape), 0, 255).astype(np.uint8)
        for name, rgb in truths(run).items()
    }


@pytest.fixture(scope="module")
def judged(small_run, tmp_path_factory):
    """The run itself, its pictures as a folder, and noisy truths, with evaluate's own figures."""
    root = tmp_path_factory.mktemp("judged")
    own = {f"generated_{f.name[:-4]}.png": f.picture for _, f, _ in load_run(small_run).targets()}
    write_pictures(root / "copied", own)
    write_pictures(root / "noisy", noisy(small_run, 0))
    assert main(["evaluate", str(small_run), "--out", str(root / "figures"), "--quiet"]) == 0
    judge(small_run, root / "copied", root / "noisy", "--against", small_run, "--out", root / "out")
    evaluation = json.loads((root / "figures" / "evaluation.json").read_text())
    return root / "out", read(root / "out"), evaluation["runs"][0]


def without_extras(images: dict) -> dict:
    """The images part with the figures of evaluate alone."""
    keep = {"name", "round", "coverage", "coverage_after", "observed", *FIGURES}
    return images | {
        "mean": {name: images["mean"][name] for name in FIGURES},
        "rounds": [{k: v for k, v in part.items() if k in keep} for part in images["rounds"]],
        "views": [{k: v for k, v in view.items() if k in keep} for view in images["views"]],
    }


def test_a_runs_own_pictures_have_the_figures_of_evaluate_to_the_bit(judged):
    _, figures, evaluation = judged
    own = figures["methods"][0]
    assert without_extras(own["images"]) == evaluation["images"]
    assert own["consistency"] == evaluation["consistency"]
    assert own["poses"] == evaluation["poses"]
    assert evaluation["images"]["mean"]["psnr"]["mean"] > 15


def test_the_same_pictures_from_a_plain_folder_differ_in_depth_alone(judged):
    _, figures, evaluation = judged
    copied = figures["methods"][1]
    assert copied["matched_by"] == "name"
    expected = evaluation["images"]["mean"]
    for name in FIGURES:
        if not name.startswith("depth"):
            assert copied["images"]["mean"][name] == expected[name]
    assert copied["images"]["mean"]["depth_rel_valid"]["mean"] is None
    assert copied["consistency"]["generated"]["depth_reprojection"]["status"].startswith("empty")
    assert copied["poses"] == evaluation["poses"]
    assert copied["consistency"]["generated"]["feature_consistency"]["score"]["n"] == 3
    assert copied["depth"] == "none; features are carried by the memory's"


def test_what_the_context_never_observed_is_one_region_for_all(judged, small_run):
    _, figures, _ = judged
    views = {view["name"]: view for view in figures["methods"][2]["images"]["views"]}
    pictures = noisy(small_run, 0)
    for _, files, truth in load_run(small_run).targets():
        rgb = truth.load().rgb
        unseen, seen = (
            psnr(pictures[files.name], rgb, mask=mask) for mask in (~files.observed, files.observed)
        )
        assert views[files.name]["psnr_never_observed"] == pytest.approx(unseen)
        assert views[files.name]["psnr_valid"] == pytest.approx(seen)


def test_differences_are_paired_over_views(judged):
    _, figures, _ = judged
    found = {
        (entry["first"], entry["second"]): entry
        for entry in figures["differences"]
        if entry["figure"] == "psnr"
    }
    assert len(found) == 3
    entry = found["run", "noisy"]
    first, second = (
        [view["psnr"] for view in figures["methods"][i]["images"]["views"]] for i in (0, 2)
    )
    apart = np.subtract(first, second)
    assert entry["mean"] == pytest.approx(apart.mean())
    assert apart.min() <= entry["low"] <= entry["mean"] <= entry["high"] <= apart.max()
    assert entry["first_better"] == (apart > 0).mean()
    # Equal pictures: no difference in any resample.
    same = found["run", "copied"]
    assert (same["mean"], same["low"], same["high"]) == (0, 0, 0)
