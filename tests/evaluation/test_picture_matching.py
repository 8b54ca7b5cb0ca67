"""Pictures matched with views by name or by order, and what is refused."""

from __future__ import annotations

import pytest

from gvtools.errors import OptionError
from gvtools.evaluation.picture_sets import match_pictures

VIEWS = tuple(f"frame-{i:06d}.color.jpg" for i in (10, 30, 50))


def partners(pictures, views, **how):
    """For each view the name of its picture."""
    found = match_pictures(pictures, views, **how)
    return found.rule, [None if i is None else pictures[i] for i in found.picture_of]


@pytest.mark.parametrize(
    ("pictures", "views"),
    [
        (["{}.png"], VIEWS),
        (["generated_{}.png"], VIEWS),
        (["{}_rgb.png"], VIEWS),
        (["step3/pred-{}.render.PNG"], VIEWS),
        (["{}.png"], ("left/1.jpg", "left/2.jpg", "right/1.jpg", "right/2.jpg")),
        (["out/{}.png"], ("left/1.jpg", "left/2.jpg", "right/1.jpg", "right/2.jpg")),
    ],
)
def test_names_match_without_endings_and_what_all_have_around_them(pictures, views):
    made = [pictures[0].format(view.rpartition(".")[0]) for view in reversed(views)]
    rule, found = partners(made, views)
    assert rule == "name"
    assert found == list(reversed(made))


def test_numbers_are_whole_names_not_parts_of_longer_ones():
    rule, found = partners(["render_11.png", "render_1.png"], ["1.jpg", "11.jpg"])
    assert (rule, found) == ("name", ["render_1.png", "render_11.png"])


def test_folders_of_the_pictures_do_not_count_where_names_are_enough():
    rule, found = partners(["test/a/1.png", "test/b/2.png"], ["1.jpg", "2.jpg"])
    assert (rule, found) == ("name", ["test/a/1.png", "test/b/2.png"])


def test_missing_and_left_over_pictures_are_told():
    found = match_pictures(["a.png", "x.png"], ["a.jpg", "b.jpg", "c.jpg"])
    assert found.picture_of == (0, None, None)
    assert found.missing == ("b.jpg", "c.jpg")
    assert found.left_over == ("x.png",)


def test_order_is_the_natural_one_of_both_sides():
    rule, found = partners(["p10.png", "p9.png"], ["view2.jpg", "view10.jpg"])
    assert (rule, found) == ("order", ["p9.png", "p10.png"])


def test_order_may_be_the_alphabetical_one_of_the_views():
    rule, found = partners(["0.png", "1.png"], ["view2.jpg", "view10.jpg"], alphabetical=True)
    assert (rule, found) == ("order", ["1.png", "0.png"])


def test_pictures_that_count_views_are_never_matched_by_name():
    # Of thirteen held-out views two are judged; 0008 is the ninth view here, not the view 0008.
    pictures = [f"val_step29999_{i:04d}.png" for i in range(13)]
    with pytest.raises(OptionError, match=r"13 pictures .*for 2 views"):
        match_pictures(pictures, ["0000.jpg", "0008.jpg"], alphabetical=True)
    views = [f"{i:04d}.jpg" for i in range(0, 104, 8)]
    assert partners(pictures, views, alphabetical=True) == ("order", pictures)


def test_names_that_match_by_chance_are_refused_where_the_order_would_do():
    # Renders counted from 0 for every eighth of the photographs, which are counted, too.
    pictures = [f"{i:05d}.png" for i in range(3)]
    views = [f"{i:05d}.jpg" for i in (0, 8, 16)]
    with pytest.raises(OptionError, match="say --match name or --match order"):
        match_pictures(pictures, views)
    assert partners(pictures, views, rule="order") == ("order", pictures)
    assert partners(pictures, views, rule="name") == ("name", ["00000.png", None, None])


@pytest.mark.parametrize(
    ("pictures", "message"),
    [
        ([], "no picture; expected one for each of 3"),
        (["x1.png", "x2.png"], "2 pictures .*for 3 views"),
        (["rgb/{0}.png", "depth/{0}.png"], "2 pictures of the view"),
        (["{0}.png", "{0}.jpg"], "2 pictures of the view"),
    ],
)
def test_what_is_not_clear_is_refused(pictures, message):
    made = [
        form.format(view.removesuffix(".jpg"))
        for form in pictures
        for view in (VIEWS if "{" in form else VIEWS[:1])
    ]
    with pytest.raises(OptionError, match=message):
        match_pictures(made, VIEWS)


def test_a_rule_that_finds_nothing_is_refused():
    with pytest.raises(OptionError, match="--match order"):
        match_pictures(["p.png"], ["a.jpg"], rule="name")
    with pytest.raises(OptionError, match="expected one of"):
        match_pictures(["p.png"], ["p.jpg"], rule="time")
