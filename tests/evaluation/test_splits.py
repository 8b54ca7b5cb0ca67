"""Splits of scenes by the rules of benchmarks, and by the protocol's."""

from __future__ import annotations

import json
from itertools import pairwise

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from gvtools.errors import OptionError, ProjectError
from gvtools.evaluation.published import load_benchmark
from gvtools.evaluation.splits import SplitRule, protocol_split, split_scene

EVERY = SplitRule(kind="every", every=8, source="test")


def names(count: int) -> list[str]:
    return [f"{i:03d}.png" for i in range(count)]


def numbers(found: tuple[str, ...]) -> list[int]:
    return [int(name[:3]) for name in found]


@pytest.mark.parametrize(
    ("count", "views", "context", "targets"),
    [
        # 17 others: 1 to 7, 9 to 15, 17 to 19; places 0, 3.2, 6.4, 9.6, 12.8, 16.
        (20, 6, [1, 4, 7, 12, 15, 19], [0, 8, 16]),
        # 10 others: 1 to 7 and 9 to 11; the middle of places 0 to 9 is 4.5, and goes to 4.
        (12, 3, [1, 5, 11], [0, 8]),
        # 12 others; the middle of 0 to 11 is 5.5, and goes to 6.
        (14, 3, [1, 7, 13], [0, 8]),
        (9, 7, [1, 2, 3, 4, 5, 6, 7], [0, 8]),
    ],
)
def test_every_eighth_is_a_target_and_the_context_is_spread_over_the_others(
    count, views, context, targets
):
    split = split_scene(EVERY, names(count), views=views)
    assert numbers(split.context) == context
    assert numbers(split.targets) == targets
    assert len(split.rounds) == 1


def test_listed_views_are_the_first_of_the_list_and_in_the_scenes_order():
    rule = load_benchmark("dtu").split_of(3)
    three = split_scene(rule, names(49), views=3)
    nine = split_scene(rule, names(49), views=9)
    assert numbers(three.context) == [22, 25, 28]
    assert numbers(nine.context) == [0, 8, 13, 22, 25, 28, 40, 44, 48]
    assert len(three.targets) == 25 and three.targets == nine.targets
    assert not set(nine.context) & set(nine.targets)


def test_the_papers_protocol_has_rounds():
    benchmark = load_benchmark("scannetv2")
    split = split_scene(
        benchmark.split_of(2), names(400), views=2, targets=6, rounds=benchmark.rounds
    )
    assert [len(names) for names in split.rounds] == [6, 6, 6]
    steps = {
        b - a for a, b in zip(numbers(split.targets), numbers(split.targets)[1:], strict=False)
    }
    assert steps == {10}


def test_released_files_number_the_frames_of_transforms_json(tmp_path):
    """Frames in another order than the pictures' names, as a file may have them."""
    rule = load_benchmark("mipnerf360-few").split_of(3)
    frames = [{"file_path": f"images_4/{name}"} for name in reversed(names(6))]
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": frames}))
    split = {"train_ids": [5, 3, 0], "test_ids": [1, 2]}
    (tmp_path / "train_test_split_3.json").write_text(json.dumps(split))
    views = [f"images_4/{name}" for name in names(6)]
    found = split_scene(rule, views, views=3, folder=tmp_path)
    assert found.context == tuple(f"images_4/{i:03d}.png" for i in (0, 2, 5))
    assert found.targets == ("images_4/004.png", "images_4/003.png")
    with pytest.raises(ProjectError, match=r"train_test_split_6\.json: unreadable"):
        split_scene(rule, views, views=6, folder=tmp_path)
    (tmp_path / "train_test_split_6.json").write_text('{"train_ids": [9], "test_ids": [0]}')
    with pytest.raises(ProjectError, match="do not fit the views"):
        split_scene(rule, views, views=6, folder=tmp_path)


def test_too_few_views_are_refused():
    with pytest.raises(OptionError, match="7 are no targets; expected at least 9"):
        split_scene(EVERY, names(9), views=9)
    with pytest.raises(OptionError, match="40 views; expected at least 48"):
        split_scene(load_benchmark("dtu").split_of(3), names(40), views=3)


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
    start, stride = split.window["start"], split.window["stride"]
    assert window == list(range(start, start + size * stride, stride))
    assert start >= 0 and window[-1] < split.window["views"] == count
    if chosen["stride"] is None:
        assert (size - 1) * (stride + 1) >= count, "not as wide as the scene allows"
    else:
        assert stride == chosen["stride"]
    layout = "ends" if chosen["rounds"] == 1 else "first"
    assert split.window["layout"] == layout
    if layout == "first":
        assert max(context) < min(targets)
    elif len(context) > 1:
        assert (context[0], context[-1]) == (window[0], window[-1])
        gaps = [(b - a) // stride for a, b in pairwise(context)]
        assert max(gaps) - min(gaps) <= 1


@given(settings)
def test_one_view_less_than_needed_is_refused(chosen):
    needed = _needed(chosen)
    names = [f"v{i}" for i in range(needed)]
    assert protocol_split(names, **chosen).window["start"] == 0
    assume(needed > 1)
    with pytest.raises(OptionError, match=f"{needed - 1} views; expected at least {needed} "):
        protocol_split(names[:-1], **chosen)


def test_a_seed_means_the_same_window_in_every_version():
    """The first draws of Python's generator, which its documentation promises to keep."""
    assert [protocol_split(NAMES, stride=5, seed=seed).window["start"] for seed in range(4)] == [
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
    assert (ends.window["layout"], long.window["layout"]) == ("ends", "first")
    widest = protocol_split(NAMES)
    assert (widest.window["stride"], widest.window["start"]) == (14, 1)
    three = protocol_split(NAMES[:9], context=3)
    assert three.context == (NAMES[0], NAMES[4], NAMES[8])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"stride": 0}, "stride 0; expected at least 1"),
        ({"stride": 15}, "100 views; expected at least 106 for 2 context and 1 x 6 target views"),
    ],
)
def test_what_cannot_be_is_refused(options, message):
    with pytest.raises(OptionError, match=message):
        protocol_split(NAMES, **options)
