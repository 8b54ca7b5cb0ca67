"""The report of a run: what it says, what it survives, and how it looks in a browser."""

from __future__ import annotations

import base64
import io
import json
import shutil
from contextlib import nullcontext
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from browser import Browser, open_browser
from command_line import refused
from figures import unpainted_figures
from matplotlib import colormaps
from PIL import Image

from gvtools.appearance.fit_options import FitOptions
from gvtools.scenes.project import open_project
from gvtools.scenes.scene import Frame
from pipelines.cli import main
from pipelines.reconstruction.prepare import make_plan
from pipelines.reconstruction.settings import RunSettings
from pipelines.report import chosen_targets, collect, write_report
from viz.plots.canvas import SKY, rgb_of
from viz.report import pictures as sheets
from viz.report.page import SheetRow, Sheets, report_html
from viz.report.pictures import contact_row

LABELS = ["context", "hint", "validity", "completion", "truth", "error"]


class Page(HTMLParser):
    """Tags, addresses and tables of a page."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.addresses: list[str] = []
        self.captions: list[str] = []
        self.rows: list[list[str]] = []
        self.said = ""
        self._within: list[str] = []
        text = path.read_text(encoding="utf-8")
        self.feed(text)
        self.style = text[text.index("<style>") : text.index("</style>")]

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self._within.append(tag)
        self.addresses += [value or "" for name, value in attrs if name in ("src", "href")]
        if tag == "tr":
            self.rows.append([])

    def handle_endtag(self, tag: str) -> None:
        while self._within and self._within.pop() != tag:
            pass

    def handle_data(self, data: str) -> None:
        inside = self._within[-1] if self._within else ""
        if inside == "figcaption":
            self.captions.append(data)
        if inside in ("td", "th"):
            self.rows[-1].append(data)
        if inside != "style":
            self.said += data


@pytest.fixture(scope="module")
def page(small_run):
    return written(small_run, painted=True)


@pytest.fixture
def own(small_run, tmp_path):
    """A copy to spoil."""
    return Path(shutil.copytree(small_run, tmp_path / "run"))


def written(run: Path, *more: object, painted: bool = False, drawn: bool = False) -> Page:
    with nullcontext() if painted else unpainted_figures(drawn=drawn):
        assert main(["report", str(run), "--quiet", *map(str, more)]) == 0
    return Page(run / "report.html")


def test_nothing_is_asked_of_the_network_and_nothing_runs(page):
    assert page.addresses
    assert all(address.startswith(("data:", "#")) for address in page.addresses)
    assert "url(" not in page.style
    assert "@import" not in page.style
    assert "script" not in page.tags


def test_the_rounds_are_those_of_the_run(small_run, page):
    rounds = [json.loads(line) for line in (small_run / "rounds.jsonl").read_text().splitlines()]
    table = [row for row in page.rows if len(row) == 15]
    assert len(table) == 1 + len(rounds)
    at = {name: table[0].index(name) for name in ("observed", "generated", "rejected")}
    for row, entry in zip(table[1:], rounds, strict=True):
        assert row[0] == str(entry["round"])
        for name, place in at.items():
            assert int(row[place].replace("\u202f", "")) == entry[name]


def test_the_figures_are_those_of_the_metrics(small_run, page):
    metrics = json.loads((small_run / "metrics.json").read_text())
    rows = {row[0]: row for row in page.rows if len(row) == 4}
    for name, key in (("PSNR, dB", "psnr"), ("SSIM", "ssim")):
        for cell, region in zip(rows[name][1:], ("", "_valid", "_generated"), strict=True):
            assert float(cell) == pytest.approx(metrics[f"{key}{region}"], rel=1e-3)
    each = [row for row in page.rows if row and row[0].startswith("frame-")]
    assert [row[0] for row in each] == [view["name"] for view in metrics["views"]]


def test_each_target_has_its_six_pictures(own, page):
    assert page.captions == LABELS * 4
    page = written(own, "--pictures", 3)
    assert page.captions == LABELS * 3
    assert "3 of 4 targets" in page.said
    assert "the other 1 lie in run/round_*" in page.said


def test_settings_that_differ_come_first_and_all_are_there(page):
    rows = page.rows
    heads = [index for index, row in enumerate(rows) if row[:2] == ["setting", "value"]]
    changed = [row[0] for row in rows[heads[0] + 1 : heads[1]]]
    everything = [row[0] for row in rows[heads[1] + 1 :]]
    assert set(changed) == {"context", "targets", "views_per_round", "refine.seconds"}
    assert len(everything) > 40
    assert "splat.depth_band" in everything


def test_an_evaluation_gives_intervals_and_estimated_poses(own):
    assert main(["evaluate", str(own), "--parts", "images,poses", "--no-control", "--quiet"]) == 0
    page = written(own, drawn=True)
    assert "evaluation/evaluation.json" in page.said
    assert "95 % interval" in page.said
    report = collect(own)
    poses = report.poses.cameras
    assert poses is not None
    assert poses.estimated is not None
    located = poses.located
    if located.any():
        apart = poses.estimated[located] - poses.requested[located]
        assert np.abs(apart).max() < 0.2
    # An evaluation of other settings says nothing of this run.
    record = json.loads((own / "run.json").read_text())
    record["settings"]["seed"] = 7
    (own / "run.json").write_text(json.dumps(record))
    report = collect(own)
    assert report.measures.source == "metrics.json"
    assert any("another state" in warning for warning in report.warnings)


def test_a_run_that_is_not_finished(own):
    shutil.rmtree(own / "round_002")
    (own / "metrics.json").unlink()
    page = written(own, drawn=True)
    assert "1 of 2 rounds are done" in page.said
    assert page.captions == LABELS * 2
    assert "There is no metrics.json yet" in page.said


def test_a_project_that_is_gone(own, small_scan, capsys):
    record = json.loads((own / "run.json").read_text())
    record["project"] = str(own / "nowhere")
    (own / "run.json").write_text(json.dumps(record))
    page = written(own, drawn=True)
    assert "no photographs" in capsys.readouterr().err
    assert page.captions == ["hint", "validity", "completion"] * 4
    assert "no error maps" in page.said
    assert "context's cameras are missing" in page.said
    shown = collect(own, project=small_scan).sheets.rows
    assert [tile.label for row in shown for tile in row.tiles] == LABELS * 4


def test_a_run_that_has_its_project_open_writes_the_same_page(own, small_scan):
    written(own)
    refine = FitOptions(seconds=0, poses=False)
    config = RunSettings(context="first:3", targets="range:4-7", views_per_round=2, refine=refine)
    before = (own / "report.html").read_bytes()
    (own / "report.html").unlink()
    with unpainted_figures():
        write_report(make_plan(open_project(small_scan), config), own)
    assert (own / "report.html").read_bytes() == before


def test_pictures_that_are_damaged_are_named(own):
    (own / "round_001" / "generated_frame-000004.color.png").write_bytes(b"no picture")
    page = written(own)
    assert page.captions == LABELS * 3
    assert "frame-000004.color.png (round 1) cannot be shown" in page.said


@pytest.mark.parametrize("content", ["{", '{"runs": [{}]}'])
def test_a_damaged_evaluation_leaves_the_runs_own_figures(own, content):
    (own / "evaluation").mkdir()
    (own / "evaluation" / "evaluation.json").write_text(content)
    report = collect(own)
    assert report.measures.source == "metrics.json"
    assert len(report.warnings) == 1 and "evaluation.json" in report.warnings[0]


def test_no_picture_outside_the_run_is_shown(own, tmp_path):
    for kind in ("guidance", "valid", "generated"):
        inside = own / "round_001" / f"{kind}_frame-000004.color.png"
        outside = tmp_path / f"{kind}.png"
        inside.rename(outside)
        inside.symlink_to(outside)
    page = written(own)
    assert page.captions == LABELS * 3
    assert "lies outside" in page.said


def test_what_is_no_run_is_refused(own, tmp_path, capsys):
    assert "run.json" in refused(capsys, "report", tmp_path)
    assert ".html" in refused(capsys, "report", own, "--out", tmp_path / "memory.npz")
    assert "--pictures" in refused(capsys, "report", own, "--pictures", 0)
    (own / "round_001" / "report.json").write_text("{}")
    assert "round_001" in refused(capsys, "report", own, "--out", tmp_path / "a.html")
    shutil.rmtree(own / "round_000")
    assert "no round is done" in refused(capsys, "report", own, "--out", tmp_path / "a.html")
    assert not (tmp_path / "a.html").exists()


def test_no_text_of_a_users_files_becomes_markup(own, tmp_path):
    evil = "<img src=x onerror=\"alert(1)\"><script>alert('2')</script>&amp;"
    report = collect(own)
    black = Frame(np.zeros((4, 6, 3), np.uint8))
    context: Any = SimpleNamespace(name=evil, load=lambda: black)
    tiles = contact_row(
        evil, hint=black.rgb, support=black.rgb[..., 0], completion=black.rgb, truth=black,
        context=context,
    )  # fmt: skip
    views = [{**view, "name": evil} for view in report.measures.views]
    report = replace(
        report, title=evil, facts=[("project", evil)], changed=[(evil, evil, evil)],
        settings={evil: evil}, warnings=[evil],
        measures=replace(report.measures, notes=[evil], views=views, source=evil),
        sheets=Sheets([SheetRow(evil, tiles)], evil),
        poses=replace(report.poses, note=evil, errors=[(evil, 1.0, None)]),
    )  # fmt: skip
    with unpainted_figures():
        (tmp_path / "evil.html").write_text(report_html(report), encoding="utf-8")
    page = Page(tmp_path / "evil.html")
    assert "script" not in page.tags
    assert all(address.startswith(("data:", "#")) for address in page.addresses)
    # Shown as it was written, in every place.
    assert page.said.count(evil) >= 13


def test_every_round_is_shown_by_its_worst_target_first():
    reports = [{"views": [{"name": f"{r}{k}", "coverage": k} for k in range(n)]}
               for r, n in enumerate((0, 3, 2, 4))]  # fmt: skip
    psnr: dict[str, float | None] = {"10": 30.0, "11": 20.0, "12": 25.0, "20": 9.0, "21": 8.0}
    assert chosen_targets(reports, psnr, 3) == [(1, 1), (2, 1), (3, 0)]
    # Then the best; where nothing was measured, coverage decides.
    assert chosen_targets(reports, psnr, 6) == [(1, 0), (1, 1), (2, 0), (2, 1), (3, 0), (3, 3)]
    assert len(chosen_targets(reports, psnr, 100)) == 9
    assert chosen_targets(reports, psnr, 2) == [(1, 1), (3, 0)]
    assert chosen_targets(reports[:1], psnr, 5) == []


@pytest.fixture(scope="module")
def browser():
    with open_browser() as opened:
        yield opened


@pytest.mark.parametrize(("width", "columns"), [(390, 2), (1280, 6)])
def test_the_page_in_a_browser(browser: Browser, small_run, page, width, columns):
    browser.resize(width, 844)
    browser.driver.get((small_run / "report.html").as_uri())
    shown = browser.driver.execute_script(
        """
        const boxes = (name) => [...document.querySelectorAll(name)].map(
            (e) => e.getBoundingClientRect().toJSON());
        return {
            wide: document.documentElement.scrollWidth,
            broken: [...document.images].filter((i) => !i.complete || !i.naturalWidth).length,
            images: boxes("img"),
            sections: [...document.querySelectorAll("section")].map(
                (e) => [e.id, e.getBoundingClientRect().height]),
            first: boxes(".tiles:first-of-type figure").slice(0, 6),
            letters: getComputedStyle(document.body).fontSize,
        };
        """
    )
    assert shown["wide"] <= width
    assert shown["broken"] == 0
    assert len(shown["images"]) > 20
    assert all(box["width"] > 100 and box["height"] > 50 for box in shown["images"])
    assert [name for name, _ in shown["sections"]] == [
        "growth", "figures", "pictures", "trajectories", "time", "settings"
    ]  # fmt: skip
    assert all(height > 80 for _, height in shown["sections"])
    top = shown["first"][0]["top"]
    assert sum(abs(box["top"] - top) < 1 for box in shown["first"]) == columns
    assert shown["letters"] == "16px"
    assert browser.foreign_requests() == [] and browser.console_errors() == []
    assert browser.picture().std() > 20


RNG = np.random.default_rng(0)


def opened(tile: sheets.Thumbnail) -> Image.Image:
    kind, data = tile.uri.split(";base64,")
    image = Image.open(io.BytesIO(base64.b64decode(data)))
    assert kind == f"data:image/{str(image.format).lower()}"
    assert image.size == (tile.width, tile.height)
    return image.convert("RGB")


def test_the_error_map_is_the_mean_absolute_difference():
    picture = RNG.integers(0, 256, (20, 30, 3)).astype(np.uint8)
    truth = RNG.integers(0, 256, (20, 30, 3)).astype(np.uint8)
    level = np.abs(picture / 255 - truth / 255).mean(axis=2) / sheets.WORST
    expected = colormaps[sheets.ERROR_MAP](np.clip(level, 0, 1))[..., :3] * 255
    # A step of the map's 256 colours.
    assert np.abs(sheets.error_map(picture, truth) - expected).max() < 5
    assert (sheets.error_map(picture, picture) == sheets.error_map(picture, picture)[0, 0]).all()


def test_what_the_mask_leaves_out_is_grey():
    picture = np.zeros((4, 4, 3), np.uint8)
    mask = np.zeros((4, 4), bool)
    mask[0] = True
    shown = sheets.error_map(picture, picture + 255, mask=mask)
    assert (shown[1:] == 128).all()
    assert shown[0, 0, 0] > 200


def test_observed_generated_and_holes_have_a_colour_each():
    shown = sheets.support_map(np.array([[255, 192, 128, 0]], np.uint8))[0]
    assert ["#" + bytes(pixel.tolist()).hex() for pixel in shown] == [
        color.lower() for color in sheets.SUPPORT.values()
    ]


def test_the_tiles_stand_in_order_and_hold_the_pictures():
    white = Frame(np.full((30, 20, 3), 255, np.uint8))
    context: Any = SimpleNamespace(name="given", load=lambda: white)
    ramp = np.tile(np.linspace(0, 255, 640)[None, :, None], (480, 1, 3)).astype(np.uint8)
    left = np.tile(np.where(np.arange(640) < 320, 255, 0).astype(np.uint8), (480, 1))
    tiles = contact_row(
        "view", hint=ramp, support=left, completion=ramp, truth=Frame(ramp), context=context
    )
    assert [tile.label for tile in tiles] == LABELS
    shown = {tile.label: np.asarray(opened(tile)) for tile in tiles}
    assert shown["context"].shape == (30, 20, 3)
    assert shown["hint"].shape == (240, 320, 3)
    assert np.diff(shown["completion"][75, :, 0].astype(int)).mean() == pytest.approx(0.8, abs=0.1)
    assert shown["error"].max() < 20
    left, right = shown["validity"][0, 0], shown["validity"][0, -1]
    assert "#" + bytes(left.tolist()).hex() == sheets.SUPPORT["observed"].lower()
    assert "#" + bytes(right.tolist()).hex() == sheets.SUPPORT["hole"]
    assert "50% observed" in tiles[2].alt
    assert "given" in tiles[0].alt


COLOR = list(rgb_of(SKY))
WIDTH, HEIGHT = 64, 48


def view(**changes) -> sheets.JudgedView:
    truth = np.full((HEIGHT, WIDTH, 3), 100, np.uint8)
    never = np.zeros((HEIGHT, WIDTH), bool)
    never[10:30, 20:40] = True
    pictures = {"exact": truth, "bright": np.full_like(truth, 250), "absent": None}
    fields = {"truth": truth, "mask": None, "never_observed": never, "pictures": pictures}
    return sheets.JudgedView(name="view", **{**fields, **changes})


def tiles(canvas: np.ndarray, line: int) -> list[np.ndarray]:
    """The tiles of a line of the sheet: truth and three methods."""
    top = sheets.LETTERS + sheets.GAP + line * (HEIGHT + sheets.GAP)
    lefts = [sheets.GAP + column * (WIDTH + sheets.GAP) for column in range(4)]
    return [canvas[top : top + HEIGHT, left : left + WIDTH] for left in lefts]


def test_a_view_has_truth_pictures_and_error_maps_below_its_methods():
    canvas = sheets.method_sheet([view()])
    truth, exact, bright, absent = tiles(canvas, 0)
    assert (exact == 100).all()
    assert (bright == 250).all()
    assert (absent == sheets.MISSING).all()
    assert (truth == 100).all()
    dimmed, exact_error, bright_error, absent_error = tiles(canvas, 1)
    assert (dimmed[10:30, 20:40] == 100).all()
    assert dimmed.astype(int).sum() == 3 * (100 * 400 + 20 * (WIDTH * HEIGHT - 400))
    rim = (exact_error == COLOR).all(axis=2)
    assert rim[10:12, 20:40].all()
    assert rim[10:30, 38:40].all()
    assert rim.sum() == 20 * 20 - 16 * 16
    inside = exact_error[13:27, 23:37]
    assert (inside == inside[0, 0]).all()
    assert inside.max() < 10
    # Off by more than the brightest difference.
    assert bright_error[0, 0].sum() > 600
    assert (bright_error == COLOR).all(axis=2).sum() == rim.sum()
    assert (absent_error == sheets.MISSING).all()


def test_without_truth_there_are_no_error_maps():
    with_truth, without = (sheets.method_sheet([one]) for one in (view(), view(truth=None)))
    assert with_truth.shape[0] - without.shape[0] == HEIGHT + sheets.GAP
