"""What readers make of damaged and hostile files: exact data or one named error, and no more.

Inputs that once failed are kept in ``tests/corpus`` and judged again here; the whole table, 10,000
mutations of each reader, is ``python -m hostile`` (docs/robustness.md).
"""

from __future__ import annotations

import ast
import json
import mmap
import shutil
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hostile import judge, samples
from hostile.__main__ import CORPUS, FFMPEG, corpus, lines, slug
from hostile.judge import FAILED, OTHER, REFUSED, SAME, Bench, limited
from hostile.mutations import Mutation, Special
from hostile.readers import READERS, Reader, data_sets
from hostile.samples import indexed_tensors, shards

from gvtools.errors import CheckpointError, ProjectError
from gvtools.networks.tensors import TensorFiles
from gvtools.scenes.project import open_project
from gvtools.scenes.shards import open_shards

ROOT = Path(__file__).parents[2]
# Beside the corpus a few mutations of every reader, so that the table itself is known to work.
A_FEW = 1


def replayed(reader: Reader, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in FFMPEG.items():
        monkeypatch.setenv(name, value)
    bench = Bench(reader, folder)
    with limited():
        cases = [*corpus(reader.name), *map(bench.mutation, range(A_FEW))]
        verdicts = [bench.judge(case) for case in cases]
    assert [verdict.why for verdict in verdicts if verdict.outcome == FAILED] == []


# Those that read dear samples, weights and USD, are judged by the table and tests of their own.
@pytest.mark.parametrize("reader", [r for r in READERS if r.share >= 0.1], ids=lambda r: r.name)
def test_what_once_failed_is_read_or_refused(reader, tmp_path, monkeypatch):
    replayed(reader, tmp_path / "bench", monkeypatch)


@pytest.mark.slow
def test_layouts_and_dear_samples_that_once_failed_are_read_or_refused(tmp_path, monkeypatch):
    for reader in (*(r for r in READERS if r.share < 0.1), *data_sets()):
        if lines(CORPUS, reader.name):
            replayed(reader, tmp_path / slug(reader.name), monkeypatch)


def test_the_corpus_belongs_to_readers_and_is_small():
    known = {slug(reader.name) for reader in (*READERS, *data_sets())}
    files = list(CORPUS.glob("*.jsonl"))
    assert {file.stem for file in files} <= known
    assert sum(file.stat().st_size for file in files) < 500_000


# --- the judge itself -------------------------------------------------------------------------


def bench(tmp_path: Path, read: Any, **more: Any) -> Bench:
    """Of a sample that is one text file with a number."""

    def make(root: Path) -> None:
        (root / "n.txt").write_text("1.5\n")

    return Bench(Reader("tried", make, read, **more), tmp_path)


@pytest.fixture(autouse=True)
def _unwatched():
    yield
    judge._watched.clear()


def number(root: Path) -> dict[str, Any]:
    """A sound reader."""
    try:
        value = float((root / "n.txt").read_text())
    except (OSError, ValueError) as error:
        raise ProjectError(f"{root / 'n.txt'}: {str(error)[:50]}") from None
    if not np.isfinite(value):
        raise ProjectError(f"{root / 'n.txt'}: {value}; expected a finite number")
    return {"number": value}


def test_a_sound_reader_passes(tmp_path):
    tried = bench(tmp_path, number)
    assert tried.judge(Mutation({"n.txt": b"1.50"})).outcome == SAME
    assert tried.judge(Mutation({"n.txt": b"2.5"})).outcome == OTHER
    for change in (b"nan", b"x", Special("absent"), Special("folder"), Special("loop")):
        assert tried.judge(Mutation({"n.txt": change})).outcome == REFUSED
    assert tried.judge(Mutation({})).outcome == SAME  # every change was undone


@pytest.mark.parametrize(
    ("read", "why"),
    [
        (lambda root: {"n": float((root / "n.txt").read_text())}, "ValueError"),
        (lambda root: {"n": 1, "kept": mapped(40 << 20)}, "took "),
        (lambda root: {"n": (root / "../outside/secret.png").read_bytes()}, "read /"),
        (lambda root: {"n": np.array([np.inf])}, "unsound"),
        (lambda root: {"n": time.monotonic_ns()}, "read twice"),
        (lambda root: refuse("a\x1b[31m"), None),
        (lambda root: refuse(""), "without words"),
    ],
)
def test_an_unsound_reader_is_found_out(tmp_path, monkeypatch, read, why):
    monkeypatch.setattr(judge, "TWICE", 1)
    monkeypatch.setattr(judge, "SPARE_BYTES", 16 << 20)

    def only_when_changed(root: Path) -> Any:
        text = (root / "n.txt").read_text()
        return {"n": 1.5} if text == "1.5\n" else read(root)

    verdict = bench(tmp_path, only_when_changed).judge(Mutation({"n.txt": b"x"}))
    if why is None:
        assert verdict.outcome == REFUSED
        return
    assert verdict.outcome == FAILED
    assert why in verdict.why


def mapped(count: int) -> Any:
    """So many bytes that no freed memory of the process serves for."""
    array = np.frombuffer(mmap.mmap(-1, count), np.uint8)
    array[:] = 1
    return array


def refuse(words: str) -> Any:
    """Raise an error of these words."""
    raise ProjectError(words)


FOLDERS = ("gvtools", "pipelines", "viz", "benchmarks", "examples", "tools", "data_specs")
FILES = sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))
# A function that goes to a process of our own over a pipe, to compile kernels there.
OWN_PIPE = {"gvtools/kernels.py"}
# Its exceptions are caught by name; torch itself unpickles, weights only.
ERRORS_ALONE = {"gvtools/networks/tensors.py"}
MODULES = {"pickle", "cPickle", "dill", "cloudpickle", "joblib", "shelve", "marshal", "jsonpickle"}
CALLS = {"load", "loads", "eval", "exec", "unsafe_load", "full_load", "read_pickle", "safe_load",
         "safe_load_all"}  # fmt: skip
RUN = {"eval", "exec", "pickle.load", "pickle.loads", "pd.read_pickle"}
OPTIONS = {"allow_pickle", "weights_only"}


def complaints(source: str, name: str = "x.py") -> list[str]:
    """What a module's source does that could run what a file says."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, (ast.Import, ast.ImportFrom)):
            modules = (
                [a.name for a in node.names] if isinstance(node, ast.Import) else [node.module]
            )
            bad = {str(module).split(".")[0] for module in modules} & MODULES
            if bad and name not in OWN_PIPE | ERRORS_ALONE:
                found.append(f"{name}:{node.lineno} imports {bad}")
        if not isinstance(node, ast.Call):
            continue
        said = {k.arg: ast.unparse(k.value) for k in node.keywords if k.arg in OPTIONS}
        if not said and getattr(node.func, "attr", getattr(node.func, "id", "")) not in CALLS:
            continue
        called = ast.unparse(node.func)
        unless_told = "" if called in ("np.load", "numpy.load") else "False"
        own_yaml = called.startswith("yaml.safe_load") and name == "gvtools/untrusted.py"
        wrong = (
            (called in RUN or (called.startswith("yaml.") and not own_yaml), "runs what it reads"),
            (said.get("allow_pickle", unless_told) != "False", "without allow_pickle=False"),
            (called == "torch.load" and said.get("weights_only") != "True", "of more than weights"),
        )
        found += [f"{name}:{node.lineno} {called} {what}" for there, what in wrong if there]
    return found


@pytest.mark.parametrize(
    "source",
    [
        "import pickle",
        "from joblib import load",
        "np.load(path)",
        "np.load(path, allow_pickle=True)",
        "np.save(path, x, allow_pickle=True)",
        "torch.load(path)",
        "torch.load(path, weights_only=False)",
        "eval(text)",
        "yaml.load(text, Loader=yaml.Loader)",
        "yaml.safe_load(text)",
    ],
)
def test_the_check_finds_what_it_looks_for(source):
    assert len(complaints(source)) == 1
    sound = "np.load(p, allow_pickle=False); torch.load(p, weights_only=True); model.eval()"
    assert complaints(sound) == []


def test_no_file_is_unpickled_or_run():
    texts = {path.relative_to(ROOT).as_posix(): path.read_text(encoding="utf-8") for path in FILES}
    assert len(texts) > 300
    assert [complaint for name in texts for complaint in complaints(texts[name], name)] == []
    assert set(texts) >= OWN_PIPE | ERRORS_ALONE  # no exception outlives its reason


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


@pytest.mark.parametrize("name", ["rgb.txt", "depth.txt", "sparse/0/images.txt"])
def test_lists_of_tum_and_images_of_colmap(tmp_path, secret, name):
    colmap = name.startswith("sparse")
    samples.colmap(tmp_path / "scan", text=True) if colmap else samples.tum(tmp_path / "scan")
    file = tmp_path / "scan" / name
    text = file.read_text()
    names = sorted(p.name for p in (tmp_path / "scan/images").rglob("*.png"))
    picture = names[0] if colmap else text.splitlines()[1].split()[1]
    for spelling in spellings(secret)[colmap:]:
        file.write_text(text.replace(picture, spelling))
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
