"""No file of a project names one outside of it: not by "..", an absolute path, or a link."""

from __future__ import annotations

import json
import shutil

import pytest
from hostile import samples
from hostile.samples import indexed_tensors, shards

from gvtools.errors import CheckpointError, ProjectError
from gvtools.networks.tensors import TensorFiles
from gvtools.scenes.project import open_project
from gvtools.scenes.shards import open_shards

OUT = "lies outside of"


@pytest.fixture
def secret(tmp_path):
    """A picture that belongs to nobody's project."""
    return samples.save(tmp_path / "outside" / "secret.png", samples.pixels())


def spellings(secret):
    """Names by which a file in ``tmp_path/scan`` or a folder in it may try to reach it."""
    up = ["../" * depth + "outside/secret.png" for depth in (1, 2, 3)]
    return [*up, "images/../../outside/secret.png", str(secret)]


@pytest.mark.parametrize("row", range(5))
@pytest.mark.parametrize("key", ["file_path", "depth_file_path", "mask_path"])
def test_transforms(tmp_path, secret, key, row):
    samples.transforms(tmp_path / "scan")
    file = tmp_path / "scan" / "transforms.json"
    data = json.loads(file.read_text())
    data["frames"][1][key] = spellings(secret)[row]
    file.write_text(json.dumps(data))
    with pytest.raises(ProjectError, match=OUT):
        open_project(tmp_path / "scan")


def test_an_image_folder_that_the_user_names_may_lie_anywhere(tmp_path):
    samples.transforms(tmp_path / "scan")
    shutil.move(tmp_path / "scan" / "images", tmp_path / "pictures")
    file = tmp_path / "scan" / "transforms.json"
    file.write_text(file.read_text().replace("images/", "../pictures/"))
    with pytest.raises(ProjectError, match=OUT):
        open_project(tmp_path / "scan")
    scene = open_project(tmp_path / "scan", images=tmp_path / "pictures")
    assert scene.names == ("a.png", "b.png")
    scene.views[0].load()


@pytest.mark.parametrize("name", ["rgb.txt", "depth.txt"])
def test_lists_of_tum(tmp_path, secret, name):
    samples.tum(tmp_path / "scan")
    file = tmp_path / "scan" / name
    for spelling in spellings(secret)[:1] + spellings(secret)[3:]:
        lines = file.read_text().splitlines()
        lines[1] = f"{lines[1].split()[0]} {spelling}"
        file.write_text("\n".join(lines))
        with pytest.raises(ProjectError, match=OUT):
            open_project(tmp_path / "scan")


def test_images_of_colmap(tmp_path, secret):
    samples.colmap(tmp_path / "scan", text=True)
    file = tmp_path / "scan" / "sparse" / "0" / "images.txt"
    text = file.read_text()
    name = sorted(p.name for p in (tmp_path / "scan" / "images").rglob("*.png"))[0]
    for spelling in spellings(secret)[1:]:
        file.write_text(text.replace(name, spelling))
        with pytest.raises(ProjectError, match=OUT):
            open_project(tmp_path / "scan")


@pytest.mark.parametrize("make", [samples.transforms, samples.tum, samples.colmap])
def test_a_picture_that_is_a_link_into_a_store_is_followed(tmp_path, make):
    make(tmp_path / "scan")
    expected = [view.load().rgb.sum() for view in open_project(tmp_path / "scan")]
    for number, file in enumerate(sorted((tmp_path / "scan").rglob("*.png"))):
        blob = tmp_path / "blobs" / str(number)
        blob.parent.mkdir(exist_ok=True)
        file.rename(blob)
        file.symlink_to(blob)
    assert [view.load().rgb.sum() for view in open_project(tmp_path / "scan")] == expected


def test_links_inside_and_a_linked_image_folder_are_followed(tmp_path):
    samples.transforms(tmp_path / "scan")
    images = tmp_path / "scan" / "images"
    (images / "a.png").rename(images / "c.png")
    (images / "a.png").symlink_to(images / "c.png")
    (tmp_path / "alias").symlink_to(tmp_path / "scan")
    assert open_project(tmp_path / "alias").names == ("a.png", "b.png")
    samples.colmap(tmp_path / "model")
    shutil.move(tmp_path / "model" / "images", tmp_path / "elsewhere")
    (tmp_path / "model" / "images").symlink_to(tmp_path / "elsewhere")
    # The folder itself is the user's own link, no file's.
    open_project(tmp_path / "model").views[0].load()


def test_an_index_of_tensors(tmp_path):
    indexed_tensors(tmp_path)
    file = next(tmp_path.glob("*.index.json"))
    shutil.copy(tmp_path / "model-1.safetensors", tmp_path.parent / "other.safetensors")
    for name in ("../other.safetensors", str(tmp_path.parent / "other.safetensors")):
        file.write_text(json.dumps({"weight_map": {"a": name}}))
        with pytest.raises((CheckpointError, ProjectError), match=OUT):
            TensorFiles.find(tmp_path)


def test_an_index_of_shards(tmp_path):
    shards(tmp_path)
    file = tmp_path / "shards" / "index.json"
    file.write_text(file.read_text().replace("shard-000000.tar", "../shard-000000.tar"))
    collection = open_shards(tmp_path / "shards")
    with pytest.raises(ProjectError, match=OUT):
        collection.read(collection.names[0])
