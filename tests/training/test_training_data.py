"""Samples of a training: rooms, pools, and recorded sources with their weights."""

from __future__ import annotations

import json
import math
from collections import Counter
from pathlib import Path

import pytest
import torch
from tiny_scan import write_scan
from training_runs import on_two, sets

from gvtools.completers.geoverse.config import named
from gvtools.errors import OptionError, ProjectError
from gvtools.scenes.data_sets.catalogue import load_spec
from gvtools.scenes.project import open_collection
from gvtools.scenes.shard_writer import ShardOptions, write_shards
from gvtools.settings import with_texts
from gvtools.training.data import Mixture, TrainingSamples
from gvtools.training.loop import load_state
from gvtools.training.options import shipped_or_read
from gvtools.training.records import read_log
from gvtools.training.samples import TrainingBatch
from pipelines.cli import main

pytestmark = pytest.mark.usefixtures("one_thread")


def micro_samples(*settings: str) -> TrainingSamples:
    config, folder = shipped_or_read("micro")
    config = with_texts(config, list(settings))
    return TrainingSamples(config, config.network(folder))


def test_holes_reach_the_model_filled_and_marked():
    batch = micro_samples().held_out(2)
    views = batch.views
    holes = ~views.valid[:, views.context :]
    assert holes.any()
    told = views.valid[:, views.context :].flatten(2).any(2)
    filled = views.depth[:, views.context :] > 0
    assert filled[told].all() and not filled[~told].any()
    # The fill is a guess at the truth, far better than none.
    error = (views.images - batch.images)[:, views.context :].abs().mean(2, keepdim=True)
    dark = batch.images[:, views.context :].mean(2, keepdim=True)
    assert error[holes & filled].mean() < 0.6 * dark[holes & filled].mean()


def test_without_projections_targets_are_black():
    plain, blind = micro_samples().held_out(2), micro_samples("data.projections=false").held_out(2)
    context = plain.views.context
    assert torch.equal(plain.images, blind.images)
    assert torch.equal(plain.views.images[:, :context], blind.views.images[:, :context])
    assert torch.equal(plain.views.depth[:, :context], blind.views.depth[:, :context])
    assert blind.views.valid[:, :context].all()
    for values in (blind.views.images, blind.views.depth, blind.views.valid):
        assert not values[:, context:].any()


def test_the_same_numbers_give_the_same_samples_and_splits_differ():
    first, again = (micro_samples().batch(range(8, 10)) for _ in range(2))
    assert torch.equal(first.images, again.images)
    assert torch.equal(first.views.images, again.views.images)
    assert not torch.equal(first.images, micro_samples().held_out(2).images)
    assert named("tiny").hints.fill == "surfaces"


def test_a_pool_repeats_and_its_files_decide_nothing(tmp_path):
    pool, cache = "data.pool=8", f"data.cache={tmp_path}"
    fresh = micro_samples(pool).batch(range(2))
    made = micro_samples(pool, cache).batch(range(2))
    again = micro_samples(pool, cache).batch(range(8, 10))
    (folder,) = tmp_path.iterdir()
    assert len(list(folder.glob("*.npz"))) == 2
    for other in (made, again):
        assert torch.equal(fresh.images, other.images)
        assert torch.equal(fresh.depth, other.depth)
        assert torch.equal(fresh.views.images, other.views.images)
        assert torch.equal(fresh.views.valid, other.views.valid)
    exact = micro_samples().batch(range(2))
    assert torch.equal(exact.images, fresh.images)
    assert torch.allclose(exact.depth, fresh.depth, rtol=1e-3)
    assert (exact.views.images - fresh.views.images).abs().max() <= 0.5 / 255 + 1e-6


def test_a_torn_file_of_a_pool_is_made_again_and_other_data_lie_elsewhere(tmp_path):
    pool, cache = "data.pool=8", f"data.cache={tmp_path}"
    whole = micro_samples(pool, cache).batch(range(1))
    (file,) = tmp_path.glob("*/*.npz")
    file.write_bytes(file.read_bytes()[:1000])
    assert torch.equal(micro_samples(pool, cache).batch(range(1)).images, whole.images)
    other = micro_samples(pool, cache, "seed=1").batch(range(1))
    assert not torch.equal(other.images, whole.images)
    assert len(list(tmp_path.iterdir())) == 2


PARTS = [range(4 * i, 4 * i + 4) for i in range(4)]


@pytest.fixture(scope="module")
def home(tmp_path_factory) -> Path:
    """A project, a download of 7-Scenes with two sequences, and shards of it."""
    home = tmp_path_factory.mktemp("home")
    write_scan(home / "kitchen", views=8)
    for name in ("chess/seq-01", "fire/seq-02"):
        write_scan(home / "7scenes" / name, views=9)
    collection = open_collection("spec:7-Scenes", home / "7scenes")
    write_shards(collection, home / "shards", options=ShardOptions(megabytes=0.1))
    return home


def settings(*entries: object, share: float = 0.5) -> list[str]:
    scenes = [f"data.scenes={json.dumps(entries)}", f"data.scene_share={share}"]
    return [*scenes, "data.scene_overlap=0.1"]


def samples(*entries: object, share: float = 0.5, more: tuple[str, ...] = ()) -> TrainingSamples:
    return micro_samples(*settings(*entries, share=share), *more)


def equal(a: TrainingBatch, b: TrainingBatch) -> bool:
    names = ("images", "depth", "valid", "cam_from_world", "K")
    same = [torch.equal(getattr(a.views, name), getattr(b.views, name)) for name in names]
    return all(same) and torch.equal(a.depth, b.depth) and a.notes == b.notes


def test_every_kind_of_source_gives_samples_of_its_weight(home):
    download = str(home / "7scenes")
    data = samples(
        str(home / "kitchen"),
        {"project": "spec:7-Scenes", "root": download},
        {"project": "spec:7-Scenes:chess/seq-01", "root": download, "weight": 50},
        str(home / "shards"),
        share=0.8,
    )
    spec = load_spec("7-Scenes")
    weights = {
        "kitchen": math.sqrt(8),
        "7-Scenes": spec.weight,
        "7-Scenes chess seq-01": 50,
        "7-Scenes (2)": spec.weight,
    }
    total = sum(weights.values())
    assert data.sources is not None
    assert {name: entry["share"] for name, entry in data.sources.items()} == pytest.approx(
        {"rooms": 0.2} | {name: 0.8 * weight / total for name, weight in weights.items()}
    )
    notes: Counter[str] = Counter()
    for part in PARTS:
        notes.update(data.batch(part).notes)
    drawn = {name: count for name, count in notes.items() if name.startswith("drawn/")}
    assert sum(drawn.values()) == 16 and len(drawn) >= 3


def test_shards_give_the_samples_of_what_they_were_made_of(home):
    whole = {"project": "spec:7-Scenes", "root": str(home / "7scenes")}
    direct, sharded = (samples(entry, share=1.0) for entry in (whole, str(home / "shards")))
    for part in PARTS[:2]:
        assert equal(direct.batch(part), sharded.batch(part))


@pytest.mark.slow
def test_two_workers_make_the_batches_and_counts_of_none(home):
    entries = (str(home / "shards"), str(home / "kitchen"))
    plain = [samples(*entries).batch(part) for part in PARTS]
    assert len({note for batch in plain for note in batch.notes}) >= 2
    with_workers = samples(*entries, more=("data.workers=2",)).batches(PARTS)
    assert all(equal(made, batch) for made, batch in zip(with_workers, plain, strict=True))


def test_a_damaged_file_costs_its_windows_alone_and_is_counted(home, tmp_path):
    folder = write_scan(tmp_path / "flawed", views=12)
    depth = folder / "frame-000006.depth.png"
    depth.write_bytes(depth.read_bytes()[:60])
    batch = samples(str(folder), share=1.0).batch(range(24, 32))
    assert batch.notes["drawn/flawed"] == 8
    assert batch.notes["resampled/flawed/unreadable"] > 0
    again = samples(str(folder), share=1.0, more=("data.pool=32", f"data.cache={tmp_path / 'p'}"))
    # A pool's files keep the notes.
    assert again.batch(range(24, 32)).notes == again.batch(range(24, 32)).notes == batch.notes


@pytest.mark.parametrize(
    ("entry", "share", "said"),
    [
        ("spec:7-Scenes", 0.5, r"spec:7-Scenes: no root; give the folder"),
        ({"project": "kitchen", "root": "."}, 0.5, "expected one for spec:NAME alone"),
        ("absent", 0.5, "no such folder"),
        ("kitchen", 0, "expected both or none"),
        ({"project": "kitchen", "weight": -1}, 0.5, r"data\.scenes.*weight"),
        ({"project": "kitchen", "weight": 0}, 0.5, r"data\.scenes: every weight is 0"),
    ],
)
def test_sources_that_cannot_be_are_one_line_before_training(home, monkeypatch, entry, share, said):
    monkeypatch.chdir(home)
    with pytest.raises((OptionError, ProjectError), match=said):
        samples(entry, share=share)


def test_the_papers_rule_is_taken_from_the_spec(home, monkeypatch):
    spec = load_spec("7-Scenes")
    mixed = load_spec("Hypersim").geometry
    assert mixed is not None and mixed.own_share == pytest.approx(2 / 3)
    texts = {"7scenes": spec.model_copy(update={"geometry": mixed})}
    monkeypatch.setattr(
        "gvtools.scenes.data_sets.catalogue.load_spec", lambda name: texts["7scenes"]
    )
    alone = samples(str(home / "shards"), share=1.0).batch(range(24, 32))
    own, fallen = (
        alone.notes.get(f"geometry/7-Scenes/{kind}", 0) for kind in ("own", "own (no estimate)")
    )
    assert own + fallen == 8 and own and fallen
    twin = {"project": str(home / "shards"), "estimated": str(home / "kitchen")}
    both = samples(twin, share=1.0).batch(range(24, 32))
    assert both.notes["geometry/7-Scenes/own"] == own
    assert both.notes["geometry/7-Scenes/estimated"] == fallen
    # Without depth of its own, a data set needs estimates.
    texts["7scenes"] = spec.model_copy(update={"geometry": mixed, "depth": None})
    with pytest.raises(OptionError, match=r"no geometry of its own .*name a project or shards"):
        samples(str(home / "shards"))
    assert isinstance(samples(twin, share=1.0)._train, Mixture)


def words(out: Path, home: Path) -> list[str]:
    start = ["train", "micro", "--stage", "encoder", "--out", str(out), "--device", "cpu"]
    texts = [*settings(str(home / "shards")), "encoder.statistics=1"]
    texts += ["encoder.optimizer.steps=5", "encoder.optimizer.batch=2"]
    return [*start, "--sheets", "0", *sets(*texts)]


def train(out: Path, home: Path, *more: str) -> int:
    return main([*words(out, home), *more])


def counts(stage: Path) -> dict[str, float]:
    """Of the last record: what happened when samples were drawn."""
    return {name: count for name, count in read_log(stage)[-1].items() if "/" in name}


@pytest.mark.slow
def test_a_continued_training_sees_the_same_samples_and_counts(home, tmp_path, capsys):
    assert train(tmp_path / "whole", home) == 0
    said = capsys.readouterr().out
    assert "samples (" in said and "of 7-Scenes" in said and "of rooms" in said
    assert train(tmp_path / "parts", home, "--until", "2") == 0
    assert train(tmp_path / "parts", home, "--resume") == 0
    counted = counts(tmp_path / "whole" / "encoder")
    assert counted == counts(tmp_path / "parts" / "encoder")
    assert counted["drawn/rooms"] + counted["drawn/7-Scenes"] == 10
    weights = [
        torch.load(tmp_path / name / "encoder" / "state.pt", weights_only=True)["model"]
        for name in ("whole", "parts")
    ]
    assert all(torch.equal(weights[0][name], weights[1][name]) for name in weights[0])


def test_other_shards_are_refused_when_a_training_goes_on(home, tmp_path, capsys):
    assert train(tmp_path / "out", home, "--until", "1", "--quiet") == 0
    state = load_state(tmp_path / "out" / "encoder", {})
    assert state is not None and set(state.identity["sources"]) == {"rooms", "7-Scenes"}
    index = home / "shards" / "index.json"
    text = index.read_text()
    try:
        index.write_text(text.replace('"max_side": null', '"max_side": 900'))
        assert train(tmp_path / "out", home, "--resume") == 2
    finally:
        index.write_text(text)
    assert "was trained with sources.7-Scenes.digest = '" in capsys.readouterr().err


@pytest.mark.slow
def test_two_processes_count_together(home, tmp_path, capsys):
    """Each its own samples, with the totals of one process."""
    more = ("--set", "data.workers=1", "--quiet")
    assert train(tmp_path / "one", home, *more) == 0
    on_two(*words(tmp_path / "two", home), *more)
    one, two = (tmp_path / name / "encoder" for name in ("one", "two"))
    assert counts(one) and counts(one) == counts(two)
    assert read_log(two)[-1]["loss"] == pytest.approx(read_log(one)[-1]["loss"], rel=1e-4)
