"""Draws of a mixture: their shares, their independence of processes, and what is drawn again."""

from __future__ import annotations

import math
from collections import Counter
from typing import Any

import numpy as np
import pytest
import torch
from scipy.stats import chi2_contingency

from gvtools.errors import DegenerateError, ProjectError
from gvtools.scenes.data_sets.catalogue import load_spec, spec_names
from gvtools.training.data import (
    TRIES,
    InvalidSampleError,
    Mixture,
    OwnOrEstimated,
    SampleSource,
    sampling_report,
    stratified_at,
)
from gvtools.training.distributed import Processes
from gvtools.training.samples import TENSORS, TrainingSample

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
    """Samples that are nothing but their number and attempt; some are invalid."""

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


def test_other_errors_are_no_invalid_samples():
    class Failing(Numbered):
        def sample(self, index, attempt=0):
            raise ProjectError("the disk is gone")

    with pytest.raises(ProjectError, match="disk"):
        Mixture((SampleSource("a", 1, Failing()),)).sample(0)


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


def test_lines_tell_each_source():
    counts = {
        "drawn/rooms": 30,
        "drawn/kitchen": 10,
        "geometry/kitchen/own": 8,
        "geometry/kitchen/own (no estimate)": 2,
        "resampled/kitchen/overlap": 3,
        "resampled/attic/unreadable": 20,
    }
    assert list(sampling_report(counts)) == [
        "0 samples (0 %) of attic; drawn again: 20 unreadable",
        "10 samples (25 %) of kitchen; geometry: 8 own, 2 own (no estimate); drawn again: "
        "3 overlap",
        "30 samples (75 %) of rooms",
    ]
