"""Which views a benchmark gives and completes."""

from __future__ import annotations

import json

import pytest
from pydantic import ValidationError

from gvtools.errors import OptionError, ProjectError
from gvtools.evaluation.published import benchmark_names, load_benchmark
from gvtools.evaluation.splits import SplitRule, split_scene

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


@pytest.mark.parametrize("kind", ["every", "listed", "files"])
def test_a_rule_that_tells_no_views_is_refused(kind):
    with pytest.raises(ValidationError, match="lacks what tells its views"):
        SplitRule(kind=kind, source="test")


def test_each_benchmark_has_a_cited_split_for_each_number_of_views():
    for name in benchmark_names():
        benchmark = load_benchmark(name)
        for views in benchmark.views:
            assert benchmark.split_of(views).source
