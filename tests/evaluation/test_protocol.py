from __future__ import annotations

import json
from itertools import pairwise

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from gvtools.errors import OptionError
from gvtools.evaluation.splits import protocol_split
from gvtools.scenes.selection import select

NAMES = tuple(f"frame-{i:06d}" for i in range(100))

settings = st.fixed_dictionaries(
    {
        "context": st.integers(1, 5),
        "targets": st.integers(1, 8),
        "rounds": st.integers(1, 4),
        "stride": st.none() | st.integers(1, 9),
        "seed": st.integers(0, 10**9),
    }
)


def _index(name: str) -> int:
    return int(name.rpartition("-")[2])


def _needed(chosen) -> int:
    window = chosen["context"] + chosen["targets"] * chosen["rounds"]
    return (window - 1) * (chosen["stride"] or 1) + 1


@given(settings, st.integers(0, 120))
def test_any_split_is_a_window_of_the_scene_cut_as_asked(chosen, spare):
    count = _needed(chosen) + spare
    names = [f"v-{i}" for i in range(count)]
    split = protocol_split(names, **chosen)
    assert len(split.context) == chosen["context"]
    assert [len(r) for r in split.rounds] == [chosen["targets"]] * chosen["rounds"]
    assert not set(split.context) & set(split.targets)
    context, targets = [*map(_index, split.context)], [*map(_index, split.targets)]
    assert context == sorted(context) and targets == sorted(targets)
    # Evenly spaced, inside the scene, from the recorded start with the recorded stride.
    window = sorted(context + targets)
    size = chosen["context"] + chosen["targets"] * chosen["rounds"]
    assert window == list(range(split.start, split.start + size * split.stride, split.stride))
    assert split.start >= 0 and window[-1] < split.views == count
    if chosen["stride"] is None:
        assert (size - 1) * (split.stride + 1) >= count, "not as wide as the scene allows"
    else:
        assert split.stride == chosen["stride"]
    layout = "ends" if chosen["rounds"] == 1 else "first"
    assert split.layout == layout
    if layout == "first":
        assert max(context) < min(targets)
    elif len(context) > 1:
        assert (context[0], context[-1]) == (window[0], window[-1])
        gaps = [(b - a) // split.stride for a, b in pairwise(context)]
        assert max(gaps) - min(gaps) <= 1


@given(settings, st.integers(0, 30))
def test_the_same_question_has_the_same_answer(chosen, spare):
    names = [f"v{i}" for i in range(_needed(chosen) + spare)]
    split = protocol_split(names, **chosen)
    assert protocol_split(tuple(names), **chosen) == split
    stored = json.loads(json.dumps(split.to_dict()))
    assert stored["context"] == list(split.context) and stored["start"] == split.start


@given(settings)
def test_one_view_less_than_needed_is_refused(chosen):
    needed = _needed(chosen)
    names = [f"v{i}" for i in range(needed)]
    assert protocol_split(names, **chosen).start == 0
    assume(needed > 1)
    with pytest.raises(OptionError, match=f"{needed - 1} views; expected at least {needed} "):
        protocol_split(names[:-1], **chosen)


def test_seeds_reach_every_start_and_no_other():
    drawn = [protocol_split(NAMES, stride=12, seed=seed).start for seed in range(500)]
    assert set(drawn) == set(range(100 - 7 * 12))
    assert max(map(drawn.count, set(drawn))) < 3 * min(map(drawn.count, set(drawn)))


def test_a_seed_means_the_same_window_in_every_version():
    """The first draws of Python's generator, which its documentation promises to keep."""
    assert [protocol_split(NAMES, stride=5, seed=seed).start for seed in range(4)] == [
        54,
        8,
        62,
        15,
    ]


def test_the_two_layouts():
    ends = protocol_split(NAMES[:8])
    assert ends.context == (NAMES[0], NAMES[7]) and ends.rounds == (NAMES[1:7],)
    long = protocol_split(NAMES[:20], rounds=3)
    assert long.context == NAMES[:2]
    assert long.rounds == (NAMES[2:8], NAMES[8:14], NAMES[14:20])
    assert (ends.layout, long.layout) == ("ends", "first")
    widest = protocol_split(NAMES)
    assert (widest.stride, widest.start) == (14, 1)
    three = protocol_split(NAMES[:9], context=3)
    assert three.context == (NAMES[0], NAMES[4], NAMES[8])


def test_a_split_reads_as_two_selections_in_its_order():
    split = protocol_split(NAMES, rounds=3, stride=4, seed=3)
    assert select(NAMES, ",".join(split.context)) == split.context
    assert select(NAMES, ",".join(split.targets)) == split.targets


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"targets": 0}, "targets 0; expected at least 1"),
        ({"context": 0}, "context 0; expected at least 1"),
        ({"rounds": 0}, "rounds 0; expected at least 1"),
        ({"stride": 0}, "stride 0; expected at least 1"),
        ({"stride": 15}, "100 views; expected at least 106 for 2 context and 1 x 6 target views"),
    ],
)
def test_what_cannot_be_is_refused(options, message):
    with pytest.raises(OptionError, match=message):
        protocol_split(NAMES, **options)
