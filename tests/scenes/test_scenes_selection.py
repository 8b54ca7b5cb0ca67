# mypy: no-check-untyped-defs
from __future__ import annotations

import pytest

from gvtools.errors import OptionError
from gvtools.scenes.selection import check_disjoint, select

NAMES = tuple(f"img{i}.png" for i in range(10))


@pytest.mark.parametrize(
    ("spec", "indices"),
    [
        ("all", range(10)),
        ("every:3", [0, 3, 6, 9]),
        ("every:4+1", [1, 5, 9]),
        ("first:2", [0, 1]),
        ("last:3", [7, 8, 9]),
        ("range:2-4", [2, 3, 4]),
        ("range:9-9", [9]),
        ("not:every:2", [1, 3, 5, 7, 9]),
        ("not:not:first:1", [0]),
        ("not:img3.png, img1.png", [0, 2, 4, 5, 6, 7, 8, 9]),
        ("img7.png,img2.png", [2, 7]),
        (" img4.png ", [4]),
    ],
)
def test_forms(spec, indices):
    assert select(NAMES, spec) == tuple(NAMES[i] for i in indices)


def test_names_in_a_file_and_names_with_commas_and_colons(tmp_path):
    listed = tmp_path / "targets.txt"
    listed.write_text("# held out\nimg9.png\n\nimg0.png\n")
    assert select(NAMES, f"@{listed}") == ("img0.png", "img9.png")
    assert select(NAMES, f"not:@{listed}") == NAMES[1:9]
    odd = ("a,b.png", "first:2", "c.png")
    assert select(odd, "a,b.png") == ("a,b.png",)
    assert select(odd, "first:2") == ("first:2",)
    assert select(odd, "not:first:2,c.png") == ("a,b.png",)
    assert select(odd, "a,b.png,c.png") == ("a,b.png", "c.png")
    assert select(odd, "c.png, a,b.png") == ("a,b.png", "c.png")
    assert select(("a", "b", "a,b"), "a,b") == ("a,b",)
    with pytest.raises(OptionError, match=r"no view named 'd:oops' among 2; did you mean"):
        select(("d:1", "d:2"), "d:1,d:oops")
    with pytest.raises(OptionError, match=r"no view named 'b\.png'"):
        select(odd, "b.png,c.png")
    with pytest.raises(OptionError, match="unreadable"):
        select(NAMES, "@nowhere.txt")


@pytest.mark.parametrize(
    ("spec", "told"),
    [
        ("img33.png", "did you mean 'img3.png'"),
        ("al", "did you mean 'all'"),
        ("evry:3", "did you mean 'every'"),
        ("every:x", "'x' after 'every'"),
        ("every:0", "steps of 1 or more"),
        ("every:50+20", "none of 10 views"),
        ("range:4-2", "0 <= A <= B <= 9"),
        ("range:4-10", "0 <= A <= B <= 9"),
        ("first:11", "there are 10 views"),
        ("first:0", "none of 10"),
        ("not:all", "none of 10"),
        ("", "none of 10"),
        ("zzz:3", "expected all, every:K"),
    ],
)
def test_wrong_selections(spec, told):
    with pytest.raises(OptionError, match=told) as error:
        select(NAMES, spec)
    assert "\n" not in str(error.value)


def test_overlap_is_refused_with_counts():
    check_disjoint(NAMES[::2], NAMES[1::2])
    with pytest.raises(OptionError, match=r"overlap in 2 views .*'img2.png'.*--allow-overlap"):
        check_disjoint(NAMES[:4], NAMES[2:])
