# mypy: no-check-untyped-defs
"""Pictures in the layouts of nerfstudio, gsplat and NerfBaselines, matched with views."""

from __future__ import annotations

import io
import tarfile

import numpy as np
import pytest
from PIL import Image

from gvtools.errors import OptionError, ProjectError
from gvtools.evaluation.picture_sets import match_pictures, open_pictures

NAMES = ("cam/2.jpg", "cam/10.jpg", "cam/30.jpg")


def picture(seed: int, *, channels: int = 3) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (12, 16, channels), np.uint8)


def save(path, rgb) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(rgb).save(path)


def png(rgb) -> bytes:
    out = io.BytesIO()
    Image.fromarray(rgb).save(out, format="PNG")
    return out.getvalue()


def loaded(found):
    return {one.name: one.load().rgb for one in found.pictures}


def test_plain_folders_are_read_with_their_folders_and_depth(tmp_path):
    save(tmp_path / "a/1.png", picture(0))
    save(tmp_path / "a/2.png", picture(1))
    save(tmp_path / ".hidden/3.png", picture(2))
    depth = np.random.default_rng(3).random((12, 16)).astype(np.float32)
    np.savez(tmp_path / "a/2.depth.npz", depth=depth)
    found = open_pictures(tmp_path)
    assert (found.layout, found.names) == ("plain folder", ("a/1.png", "a/2.png"))
    assert np.array_equal(loaded(found)["a/1.png"], picture(0))
    assert found.pictures[0].load().depth is None
    assert np.array_equal(found.pictures[1].load().depth, depth)


def test_the_pictures_of_gvtools_render_are_read_without_their_other_files(tmp_path):
    for kind in ("rgb", "valid", "confidence"):
        save(tmp_path / f"frame-1.color.{kind}.png", picture(0))
    np.savez(tmp_path / "frame-1.color.depth.npz", depth=np.ones((12, 16), np.float32))
    found = open_pictures(tmp_path)
    assert (found.layout, found.names) == ("gvtools render", ("frame-1.color.png",))
    assert found.pictures[0].load().depth.sum() == 12 * 16


def test_transparent_pixels_lie_before_black(tmp_path):
    rgba = picture(0, channels=4)
    save(tmp_path / "1.png", rgba)
    expected = np.rint(rgba[..., :3] * (rgba[..., 3:] / 255.0))
    found = open_pictures(tmp_path)
    assert np.array_equal(loaded(found)["1.png"], expected)
    opaque = found.pictures[0].load().mask
    assert opaque is not None and np.array_equal(opaque, rgba[..., 3] == 255)


@pytest.mark.parametrize("folder", ["", "test"])
def test_ns_render_dataset(tmp_path, folder):
    # OUT/SPLIT/OUTPUT/NAME, NAME with the ending of the render.
    for split in ("test", "train"):
        for number, name in enumerate(NAMES):
            file = name.replace(".jpg", ".png")
            save(tmp_path / split / "rgb" / file, picture(number))
            save(tmp_path / split / "gt-rgb" / file, picture(number + 10))
            save(tmp_path / split / "depth" / file, picture(number + 20))
    found = open_pictures(tmp_path / folder)
    assert found.layout == "nerfstudio, ns-render dataset"
    assert found.names == ("cam/2.png", "cam/10.png", "cam/30.png")
    assert np.array_equal(found.pictures[1].load().rgb, picture(1))
    assert np.array_equal(found.pictures[1].load_truth(), picture(11))
    assert found.notes == (() if folder else ("split test taken; also there: train",))


def test_ns_eval(tmp_path):
    for number in range(2):
        canvas = np.concatenate([picture(number), picture(number + 10)], axis=1)
        Image.fromarray(canvas).save(tmp_path / f"{number:06d}-img.jpg", quality=100, subsampling=0)
        save(tmp_path / f"{number:06d}-depth.jpg", picture(5))
    found = open_pictures(tmp_path)
    assert (found.layout, len(found.pictures)) == ("nerfstudio, ns-eval", 2)
    assert found.alphabetical
    # JPEG at its best quality is some levels off.
    render, truth = found.pictures[1].load().rgb, found.pictures[1].load_truth()
    assert np.abs(render.astype(int) - picture(11)).mean() < 5
    assert np.abs(truth.astype(int) - picture(1)).mean() < 5


@pytest.mark.parametrize("folder", ["", "renders"])
def test_gsplat(tmp_path, folder):
    for step in (6999, 29999):
        for number in range(3):
            canvas = np.concatenate([picture(number), picture(step + number)], axis=1)
            save(tmp_path / f"renders/val_step{step}_{number:04d}.png", canvas)
    save(tmp_path / "renders/compress_step29999_0000.png", picture(0))
    (tmp_path / "stats").mkdir()
    found = open_pictures(tmp_path / folder)
    assert (found.layout, found.alphabetical) == ("gsplat", True)
    assert found.names == tuple(f"val_step29999_{i:04d}.png" for i in range(3))
    assert np.array_equal(found.pictures[2].load().rgb, picture(29999 + 2))
    assert np.array_equal(found.pictures[2].load_truth(), picture(2))
    assert "also there: compress_step29999, val_step6999" in found.notes[1]


def members() -> dict[str, bytes]:
    """What NerfBaselines writes of each picture, and once."""
    out = {"info.json": b"{}"}
    for number, name in enumerate(NAMES):
        stem = name.removesuffix(".jpg")
        out[f"color/{stem}.png"] = png(picture(number))
        out[f"gt-color/{stem}.png"] = png(picture(number + 10))
        out[f"depth-rgb/{stem}.png"] = png(picture(number + 20))
        out[f"depth/{stem}.bin"] = b"\0"
        out[f"cameras/{stem}.npz"] = b"\0"
    return out


def write_archive(path, entries) -> None:
    with tarfile.open(path, "w:gz") as tar:
        for name, content in entries.items():
            info = tarfile.TarInfo(name)
            info.size = len(content)
            tar.addfile(info, io.BytesIO(content))


@pytest.mark.parametrize("form", ["folder", "archive", "training"])
def test_nerfbaselines(tmp_path, form):
    path = tmp_path
    if form == "folder":
        for name, content in members().items():
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / name).write_bytes(content)
    elif form == "archive":
        path = tmp_path / "predictions.tar.gz"
        write_archive(path, members())
    else:
        write_archive(tmp_path / "predictions-30000.tar.gz", members())
        write_archive(tmp_path / "predictions-7000.tar.gz", {"color/x.png": png(picture(9))})
        (tmp_path / "results-30000.json").write_text("{}")
    found = open_pictures(path)
    assert found.layout == "NerfBaselines"
    assert found.names == ("cam/2.png", "cam/10.png", "cam/30.png")
    assert np.array_equal(found.pictures[1].load().rgb, picture(1))
    assert np.array_equal(found.pictures[1].load_truth(), picture(11))
    taken = ("predictions-30000.tar.gz taken, the last of 2",)
    assert found.notes == (taken if form == "training" else ())


@pytest.mark.parametrize("place", ["", "test", "test/ours_30000", "test/ours_30000/renders"])
def test_renders_of_3dgs_and_its_descendants(tmp_path, place):
    for step in (7000, 30000):
        for number in range(11):
            for kind, value in (("renders", step // 1000), ("gt", 200)):
                file = tmp_path / f"test/ours_{step}/{kind}/{number:05d}.png"
                save(file, np.full((4, 6, 3), value + number, np.uint8))
    found = open_pictures(tmp_path / place)
    assert (found.layout, found.alphabetical, len(found.pictures)) == ("3DGS", True, 11)
    assert found.pictures[10].load().rgb[0, 0, 0] == 40
    assert found.pictures[10].load_truth()[0, 0, 0] == 210


def test_what_holds_no_pictures_is_refused(tmp_path, monkeypatch):
    with pytest.raises(ProjectError, match="no such folder"):
        open_pictures(tmp_path / "absent")
    with pytest.raises(ProjectError, match="no pictures"):
        open_pictures(tmp_path)
    (tmp_path / "a.zip").write_bytes(b"x")
    with pytest.raises(ProjectError, match="is a file"):
        open_pictures(tmp_path / "a.zip")
    (tmp_path / "predictions.tar.gz").write_bytes(b"x")
    with pytest.raises(ProjectError, match="expected an archive"):
        open_pictures(tmp_path / "predictions.tar.gz")
    monkeypatch.setattr("gvtools.untrusted.UNPACKED_BYTES", 1 << 20)
    write_archive(tmp_path / "large.tar.gz", {"color/a.png": bytes(2 << 20)})
    with pytest.raises(ProjectError, match="more than such a file can hold"):
        open_pictures(tmp_path / "large.tar.gz")
    write_archive(tmp_path / "empty.tar.gz", {"info.json": b"{}"})
    with pytest.raises(ProjectError, match="no pictures under color/"):
        open_pictures(tmp_path / "empty.tar.gz")


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("val_step0_0000.png", png(picture(0)[:, :15]), "15 pixels wide"),
        ("1.png", png(picture(0))[:60], r"1\.png"),
    ],
)
def test_a_canvas_that_is_no_pair_and_a_damaged_picture_are_named(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ProjectError, match=message):
        open_pictures(tmp_path).pictures[0].load()


BY_VIEW, ZERO = {"alphabetical": True}, {"others": ["f_000.jpg"]}
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


@pytest.mark.parametrize(
    ("pictures", "views", "how", "expected"),
    [
        # Numbers are whole names, not parts of longer ones.
        (["r_11.png", "r_1.png"], ["1.jpg", "11.jpg"], {}, ("name", ["r_1.png", "r_11.png"])),
        # Folders of the pictures do not count where names are enough.
        (["a/1.png", "b/2.png"], ["1.jpg", "2.jpg"], {}, ("name", ["a/1.png", "b/2.png"])),
        # The order is the natural one of both sides, or the alphabetical one of the views.
        (["p10.png", "p9.png"], ["v2.jpg", "v10.jpg"], {}, ("order", ["p9.png", "p10.png"])),
        (["0.png", "1.png"], ["v2.jpg", "v10.jpg"], BY_VIEW, ("order", ["1.png", "0.png"])),
        # Zeros before numbers do not count, nor the sign that joins folders.
        (["4.png", "12.png"], ["f_012.jpg", "f_004.jpg"], ZERO, ("name", ["12.png", "4.png"])),
        (["b_1.png", "a_1.png"], ["a/1.jpg", "b/1.jpg"], {}, ("name", ["a_1.png", "b_1.png"])),
    ],
)
def test_partners(pictures, views, how, expected):
    assert partners(pictures, views, **how) == expected


def test_missing_and_left_over_pictures_are_told():
    found = match_pictures(["a.png", "x.png"], ["a.jpg", "b.jpg", "c.jpg"])
    assert found.picture_of == (0, None, None)
    assert found.missing == ("b.jpg", "c.jpg")
    assert found.left_over == ("x.png",)


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


def test_pictures_named_like_other_views_are_refused():
    others, views = ["k-001.color.png", "k-003.color.png"], ["k-002.color.png", "k-004.color.png"]
    for names in (others, ["001.png", "003.png"], ["gen_k-001.jpg", "gen_k-003.jpg"]):
        with pytest.raises(
            OptionError, match=r"named like views that are not judged.*--match order"
        ):
            match_pictures(names, views, others=others)
        assert match_pictures(names, views, others=others, rule="order").picture_of == (0, 1)
    assert match_pictures(["x.png", "y.png"], views, others=others).rule == "order"


@pytest.mark.parametrize("form", ["{}.png", "gen_{}.jpg", "k-{}.rgb.png"])
def test_affixes_that_views_share_are_stripped(form):
    views = ["cam/k-012.color.png", "cam/k-004.color.png", "cam/k-001.color.png"]
    found = match_pictures([form.format(n) for n in ("001", "012")], views)
    assert (found.rule, found.picture_of) == ("name", (1, None, 0))


@pytest.mark.parametrize(
    ("pictures", "views", "others"),
    [
        # Another camera's of a rig, in folders and flat.
        ("cam1/{}.png", "cam0/{}.jpg", "cam1/{}.jpg"),
        ("cam1_{}.png", "cam0/{}.jpg", "cam1/{}.jpg"),
        # Numbers without the zeros in front, of other views and of none.
        ("{}.png", "f_00{}5.jpg", "f_000{}.jpg"),
        ("{}7.png", "f_00{}5.jpg", "f_000{}.jpg"),
        # Taken 0.4 s apart.
        ("140{}.25.png", "140{}.65.png", "{}"),
    ],
)
def test_pictures_of_other_views_and_times_stand_for_none(pictures, views, others):
    names = [[form.format(n) for n in (2, 4, 7)] for form in (pictures, views, others)]
    with pytest.raises(OptionError, match="--match order"):
        match_pictures(names[0], names[1], others=names[2])
    assert match_pictures(names[0], names[1], rule="order").picture_of == (0, 1, 2)
