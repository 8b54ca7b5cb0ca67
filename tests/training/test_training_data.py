from __future__ import annotations

import json
import math
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.stats import chi2_contingency
from tiny_scan import write_scan
from training_runs import on_two, sets

from gvtools.completers.geoverse.config import named
from gvtools.errors import DegenerateError, OptionError, ProjectError
from gvtools.scenes.data_sets.catalogue import load_spec, spec_names
from gvtools.scenes.project import open_collection
from gvtools.scenes.shard_writer import ShardOptions, write_shards
from gvtools.settings import with_texts
from gvtools.training.data import (
    TRIES,
    InvalidSampleError,
    Mixture,
    OwnOrEstimated,
    SampleSource,
    TrainingSamples,
    stratified_at,
)
from gvtools.training.distributed import Processes
from gvtools.training.loop import load_state
from gvtools.training.options import shipped_or_read
from gvtools.training.records import read_log
from gvtools.training.samples import TENSORS, TrainingBatch, TrainingSample
from pipelines.cli import main

pytestmark = pytest.mark.usefixtures("one_thread")


def micro_samples(*settings: str) -> TrainingSamples:
    config, folder = shipped_or_read("micro")
    config = with_texts(config, ["data.size=[24,24]", *settings])
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
        ("spec:7-Scenes", 0.5, r"spec:7-Scenes: where 7-Scenes lies is not said; give the folder"),
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
    texts = [*settings(str(home / "shards")), "data.size=[24,24]", "encoder.statistics=1"]
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
    more = ("--set", "data.workers=1", "--quiet")
    assert train(tmp_path / "one", home, *more) == 0
    on_two(*words(tmp_path / "two", home), *more)
    one, two = (tmp_path / name / "encoder" for name in ("one", "two"))
    assert counts(one) and counts(one) == counts(two)
    assert read_log(two)[-1]["loss"] == pytest.approx(read_log(one)[-1]["loss"], rel=1e-4)


MILLION = 10**6
# Images of the paper's fifteen data sets, as its appendix lists them.
PAPER = {
    "Aria Digital Twin": 232115,
    "ARKitScenes": 125134,
    "DL3DV": 3594809,
    "MapFree": 515113,
    "ScanNet++ v2": 1032198,
    "Waymo": 790405,
    "RealEstate10K": 8832823,
    "GTA-SfM": 17649,
    "Hypersim": 17348,
    "MVSSynth": 12000,
    "OmniWorld": 794596,
    "TartanAir": 613274,
    "TartanAir v2": 7135955,
    "Virtual KITTI": 42520,
    "Spring": 5000,
}


class Numbered:
    def __init__(self, name: str = "", invalid=lambda index, attempt: None) -> None:
        self.name, self.invalid = name, invalid

    def sample(self, index: int, attempt: int = 0) -> TrainingSample:
        reason = self.invalid(index, attempt)
        if reason:
            raise InvalidSampleError(reason, f"{self.name} {index} {attempt}")
        number = torch.tensor([index, attempt])
        tensors: dict[str, Any] = dict.fromkeys(TENSORS, number)
        return TrainingSample(**tensors, context=1)

    def describe(self) -> dict[str, str]:
        return {"name": self.name}


def mixture(weights: dict[str, float], **invalid) -> Mixture:
    return Mixture(
        tuple(
            SampleSource(
                name, weight, Numbered(name, invalid.get(name, lambda index, attempt: None))
            )
            for name, weight in weights.items()
        )
    )


def sigmas(counts: np.ndarray, shares: np.ndarray) -> np.ndarray:
    """Distances of counts from what is expected, in standard deviations of a binomial."""
    total = counts.sum()
    return np.abs(counts - total * shares) / np.sqrt(total * shares * (1 - shares))


def test_a_million_draws_have_the_shares_of_the_papers_table(record_property):
    training = [name for name in spec_names() if "training" in load_spec(name).roles]
    weights = {load_spec(name).name: load_spec(name).weight for name in training}
    assert weights == pytest.approx({name: math.sqrt(count) for name, count in PAPER.items()})
    root = np.sqrt([PAPER[name] for name in weights])
    largest = []
    for seed in range(3):
        data = Mixture(mixture(weights).sources, seed)
        counts = np.bincount(data.choose_sources(0, MILLION), minlength=len(weights))
        largest.append(float(sigmas(counts, root / root.sum()).max()))
    record_property("largest_sigma", max(largest))
    assert max(largest) < 3


def test_neighbouring_draws_do_not_know_of_each_other():
    drawn = mixture({"a": 1, "b": 2, "c": 5, "d": 1}).choose_sources(0, MILLION)
    for apart in (1, 4, 512):
        pairs = np.bincount(drawn[:-apart] * 4 + drawn[apart:], minlength=16).reshape(4, 4)
        assert chi2_contingency(pairs).pvalue > 1e-3


def test_a_million_draws_mix_geometry_two_to_one_in_every_source():
    own = OwnOrEstimated(Numbered(), Numbered(), 2 / 3).wants_own(0, MILLION)
    drawn = mixture({"a": 1, "b": 3}).choose_sources(0, MILLION)
    for source in (0, 1):
        chosen = own[drawn == source]
        assert sigmas(np.array([chosen.sum(), (~chosen).sum()]), np.array([2, 1]) / 3).max() < 3
    again = OwnOrEstimated(Numbered(), Numbered(), 2 / 3).wants_own(0, 1000, attempt=1)
    assert 0.4 < (again == own[:1000]).mean() < 0.7


def test_a_draw_is_the_same_alone_and_among_others():
    data = mixture({"a": 1, "b": 2, "none": 0, "c": 4})
    whole = data.choose_sources(0, 300)
    assert set(whole.tolist()) == {0, 1, 3}
    assert [int(data.choose_sources(n, 1)[0]) for n in range(300)] == whole.tolist()
    for number in (0, 7, 123):
        (note,) = data.sample(number).notes
        assert note == f"drawn/{data.sources[whole[number]].name}"
    other = Mixture(data.sources, seed=1)
    assert not np.array_equal(other.choose_sources(0, 300), whole)
    far = 10**12 + 1022
    assert stratified_at(far, 3, stream=[4])[2] == stratified_at(far + 2, 1, stream=[4])[0]


@pytest.mark.parametrize("count", [1, 2, 4])
def test_processes_share_the_same_stream_without_overlap(count):
    data = mixture({"a": 1, "b": 2})
    seen: dict[int, tuple[str, ...]] = {}
    for rank in range(count):
        process = Processes(rank, count, torch.device("cpu"))
        for step in range(6):
            for number in process.share(range(8 * step, 8 * step + 8)):
                assert number not in seen
                seen[number] = data.sample(number).notes
    assert seen == {number: data.sample(number).notes for number in range(48)}


def test_an_invalid_sample_is_drawn_again_from_its_source_and_counted():
    def half(index, attempt):
        return ("overlap", "unreadable")[index % 2] if (index + attempt) % 4 < 2 else None

    data = mixture({"good": 1, "flawed": 1}, flawed=half)
    drawn = data.choose_sources(0, 400)
    notes = Counter(note for index in range(400) for note in data.sample(index).notes)
    wanted = Counter(f"drawn/{data.sources[n].name}" for n in drawn)
    # What is invalid costs a source nothing of its share.
    assert {k: v for k, v in notes.items() if k.startswith("drawn")} == wanted
    tries: Counter[str] = Counter()
    for index in np.flatnonzero(drawn == 1).tolist():
        attempt = 0
        while (reason := half(index, attempt)) is not None:
            tries[f"resampled/flawed/{reason}"] += 1
            attempt += 1
    assert len(tries) == 2
    assert {k: v for k, v in notes.items() if k.startswith("resampled")} == tries
    first = int(np.flatnonzero((drawn == 1) & (np.arange(400) % 4 == 0))[0])
    assert data.sample(first).images.tolist() == [first, 2]


def test_a_source_without_any_valid_sample_leaves_its_place_to_others():
    def never(index, attempt):
        return "unreadable"

    data = mixture({"good": 1, "broken": 3, "fine": 2}, broken=never)
    broken = np.flatnonzero(data.choose_sources(0, 600) == 1).tolist()
    places: Counter[str] = Counter()
    for index in broken:
        notes = data.sample(index).notes
        assert notes[:-1] == ("resampled/broken/unreadable",) * TRIES
        places[notes[-1]] += 1
    counts = np.array([places["drawn/good"], places["drawn/fine"]])
    assert counts.sum() == len(broken) and sigmas(counts, np.array([1, 2]) / 3).max() < 3
    alone = mixture({"broken": 1, "unused": 0}, broken=never)
    with pytest.raises(DegenerateError, match=r"^sample 3: 10 draws .* of broken: broken 3 9$"):
        alone.sample(3)


def test_geometry_falls_back_and_every_fall_is_noted():
    def incomplete(index, attempt):
        return "depth" if index % 3 == 0 else None

    def notes(data: OwnOrEstimated) -> Counter:
        counts: Counter = Counter()
        for index in range(300):
            try:
                counts.update(data.sample(index).notes)
            except InvalidSampleError as error:
                counts[error.reason] += 1
        return counts

    own, plain = Numbered("own", incomplete), Numbered("estimated")
    wants = OwnOrEstimated(own, plain, 2 / 3).wants_own(0, 300)
    bad = np.arange(300) % 3 == 0
    assert notes(OwnOrEstimated(own, plain, 2 / 3)) == {
        "geometry/own": (wants & ~bad).sum(),
        "geometry/estimated (own depth incomplete)": (wants & bad).sum(),
        "geometry/estimated": (~wants).sum(),
    }
    assert notes(OwnOrEstimated(own, None, 2 / 3)) == {
        "geometry/own": (wants & ~bad).sum(),
        "geometry/own (no estimate)": (~wants & ~bad).sum(),
        "depth": bad.sum(),
    }
    # Of a file that cannot be read, an estimate is none.
    unread = Numbered("own", lambda index, attempt: "unreadable")
    assert notes(OwnOrEstimated(unread, plain, 1.0)) == {"unreadable": 300}
    named = Mixture((SampleSource("kitchen", 1, OwnOrEstimated(own, plain, 1.0)),)).sample(1)
    assert named.notes == ("drawn/kitchen", "geometry/kitchen/own")
