"""Learned features end in COLMAP's database, and in a model."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch
from command_line import refused
from PIL import Image
from random_features import write_disk

from gvtools.capture import mapping
from gvtools.capture.mapping import MappingTask, find_cameras
from gvtools.errors import CheckpointError, OptionError
from gvtools.features import Features, LightGlueMatcher, SiftMatcher


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    return write_disk(tmp_path_factory.mktemp("weights"))


def test_published_forms_are_read_and_others_refused(weights, tmp_path, capsys):
    matcher = LightGlueMatcher("disk", weights=weights, max_features=64)
    stored = torch.load(weights[0], weights_only=True)["extractor"]
    for name, tensor in matcher._extractor.state_dict().items():
        assert torch.equal(tensor, stored[name]), name
    older = torch.load(weights[1], weights_only=True)
    found = matcher._matcher.state_dict()
    for old, new in (
        ("self_attn.8.Wqkv.weight", "transformers.8.self_attn.Wqkv.weight"),
        ("cross_attn.0.to_qk.bias", "transformers.0.cross_attn.to_qk.bias"),
        ("posenc.Wr.weight", "posenc.Wr.weight"),
    ):
        assert torch.equal(found[new], older[old]), new

    with pytest.raises(CheckpointError, match="another network"):
        LightGlueMatcher("disk", weights=(weights[1], weights[0]))
    with pytest.raises(OptionError, match="1 weights files"):
        LightGlueMatcher("disk", weights=weights[:1])
    bad = tmp_path / "bad.pth"
    stored["unet.path_down.0.1.3.bias"] = torch.full((16,), float("nan"))
    torch.save({"extractor": stored}, bad)
    with pytest.raises(CheckpointError, match="not finite"):
        LightGlueMatcher("disk", weights=(bad, weights[1]))
    torch.save({"extractor": Path}, bad, _use_new_zipfile_serialization=False)
    with pytest.raises(CheckpointError, match="nothing of it was run"):
        LightGlueMatcher("disk", weights=(bad, weights[1]))

    (tmp_path / "photos").mkdir()
    command = ("capture", tmp_path / "photos", "--out", tmp_path / "out")
    assert "of --features aliked or disk" in refused(capsys, *command, "--weights", *weights)
    absent = ("--features", "disk", "--weights", tmp_path / "none.pth", weights[1])
    assert "none.pth; download it" in refused(capsys, *command, *absent)


def test_keypoints_are_in_the_pictures_pixels(tmp_path: Path) -> None:
    class Corner:
        """Finds the centre of the one white pixel of a reduced picture, and its black corner."""

        def extract(self, rgb: np.ndarray) -> Features:
            row, column = np.unravel_index(rgb[..., 0].argmax(), rgb.shape[:2])
            xy = np.array([[column + 0.5, row + 0.5], [0.5, 0.5]])
            return Features(xy, np.eye(2, dtype=np.float32), rgb.shape[1], rgb.shape[0])

        def match(self, first: Features, second: Features) -> np.ndarray:
            return np.zeros((0, 2), np.int64)

    side = 2 * mapping.LEARNED_SIDE
    pixels = np.zeros((side // 2, side, 3), np.uint8)
    pixels[200:202, 1000:1002] = 255
    Image.fromarray(pixels).save(tmp_path / "a.png")
    mask = np.full(pixels.shape[:2], 255, np.uint8)
    mask[:100] = 0
    (tmp_path / "masks").mkdir()
    Image.fromarray(mask).save(tmp_path / "masks/a.png.png")
    whole = mapping.learned_features(tmp_path, ["a.png"], Corner())["a.png"]
    assert (whole.width, whole.height) == (side, side // 2)
    assert np.allclose(whole.xy, [[1001, 201], [1, 1]])
    masked = mapping.learned_features(tmp_path, ["a.png"], Corner(), masks=tmp_path / "masks")
    assert np.allclose(masked["a.png"].xy, [[1001, 201]])

    database = tmp_path / "database.db"
    pycolmap.Database.open(database).close()
    pycolmap.import_images(database, tmp_path, image_names=["a.png"])
    mapping.write_keypoints(database, {"a.png": whole})
    with pycolmap.Database.open(database) as opened:
        stored = opened.read_keypoints(opened.read_all_images()[0].image_id)
    assert np.allclose(np.asarray(stored)[:, :2], whole.xy)


NETWORKS = [pytest.param(name, marks=pytest.mark.slow) for name in ("aliked", "disk")]


@pytest.mark.parametrize("extractor", ["sift", *NETWORKS])
def test_what_a_matcher_finds_becomes_a_model(extractor, room, centre_error, tmp_path):
    """Of SIFT by the way that learned features take: the same cameras as by COLMAP's own."""
    sift = extractor == "sift"
    try:
        matcher = SiftMatcher() if sift else LightGlueMatcher(extractor)
    except CheckpointError as absent:
        pytest.skip(str(absent))
    names = sorted(path.name for path in (room / "images").iterdir())[:7]
    mapped = find_cameras(MappingTask(room / "images", [names], tmp_path, learned=matcher))
    assert mapped.matching == "all pairs"
    images = [image for image in mapped.model.images.values() if image.has_pose]
    assert len(images) >= 6
    centers = [image.projection_center() for image in images]
    assert centre_error([image.name for image in images], centers) < (0.03 if sift else 0.05)
