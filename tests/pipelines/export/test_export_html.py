"""The page to share: what it packs, and what a headless browser shows of it from a file."""

from __future__ import annotations

import base64
import gzip
import json
import os
import re
import shutil
import time

import numpy as np
import pytest
from browser import open_browser
from export_runs import export_run
from scipy.spatial.transform import Rotation
from splat_scene import psnr
from web_page import PATIENCE, wait

from gvtools.appearance.appearance import Appearance
from gvtools.appearance.gaussians import Gaussians
from gvtools.cameras import Cameras
from gvtools.memory.store.local_frame import LocalFrame
from pipelines.export.formats import ExportOptions
from pipelines.export.source import ExportSource
from viz.page.page import PageCamera, PageGroup, SharedPage, pack_gaussians, page_html


def halves(words):
    """The low and the high half-precision number of each word."""
    return [(part & 0xFFFF).astype("<u2").view("<f2") for part in (words, words >> 16)]


def unpacked_turns(words):
    """Rotation matrices as Spark's shader takes them from a word."""
    u, v = ((words >> shift & 1023) / 1023 * 2 - 1 for shift in (0, 10))
    z = 1 - np.abs(u) - np.abs(v)
    fold = np.maximum(-z, 0)
    axis = np.stack([u - np.sign(u) * fold, v - np.sign(v) * fold, z], axis=1)
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    return Rotation.from_rotvec(axis * (words >> 20)[:, None] * (np.pi / 4095)).as_matrix()


def unpacked_color(words):
    """Three numbers of one exponent, as Spark's shader takes them from a word."""
    steps = np.stack([words >> shift & 255 for shift in (0, 8, 16)], axis=-1)
    signs = np.stack([words >> shift & 1 for shift in (24, 25, 26)], axis=-1)
    power = (words >> 27).astype(int) - 15
    return np.where(signs, -1, 1) * steps * 2.0 ** power[..., None] / 255


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_words_hold_what_was_packed(degree):
    rng = np.random.default_rng(degree)
    count, terms = 2000, (degree + 1) ** 2
    q = rng.normal(size=(count, 4)).astype(np.float32)
    q[:3] = [1, 0, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1]
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    sh = (
        rng.normal(size=(count, terms, 3)) * rng.choice([1e-4, 0.1, 3], (count, terms, 1))
    ).astype(np.float32)
    positions = rng.normal(scale=100, size=(count, 3)).astype(np.float32)
    log_scales = rng.uniform(-9, 2, (count, 3)).astype(np.float32)
    logits = rng.uniform(-5, 8, count).astype(np.float32)
    first, second, *rest = pack_gaussians(
        positions, log_scales=log_scales, quaternions=q, logits=logits, harmonics=sh
    )
    assert len(rest) == (0, 1, 2, 4)[degree]
    np.testing.assert_array_equal(first[:, :3].copy().view("<f4"), positions)
    np.testing.assert_allclose(halves(first[:, 3])[0], 1 / (1 + np.exp(-logits)), rtol=1e-3)
    red_green, blue_x, y_z = (halves(second[:, k]) for k in range(3))
    color = np.stack([*red_green, blue_x[0]], axis=1)
    np.testing.assert_allclose(color, 0.5 + 0.28209479 * sh[:, 0], rtol=1e-3, atol=1e-3)
    sizes = np.stack([blue_x[1], *y_z], axis=1)
    np.testing.assert_allclose(sizes, log_scales, rtol=1e-3)
    np.testing.assert_allclose(
        unpacked_turns(second[:, 3]), Rotation.from_quat(q[:, [1, 2, 3, 0]]).as_matrix(), atol=8e-3
    )
    if rest:
        found = unpacked_color(np.concatenate(rest, axis=1)[:, : terms - 1])
        largest = np.abs(sh[:, 1:]).max(axis=2, keepdims=True)
        assert (np.abs(found - sh[:, 1:]) <= largest / 255 + 2.0**-15 / 255).all()


def scene_of(path):
    """What the page's script reads, and its groups: round, generated, fitted, count, words."""
    text = path.read_text("utf-8")
    (data,) = re.findall(r'id="scene"[^>]*>(.*?)</script>', text, re.S)
    groups = []
    for numbers, words in re.findall(r'data-group="([^"]*)">([^<]*)<', text):
        round_, generated, fitted, count = map(int, numbers.split())
        array = np.frombuffer(gzip.decompress(base64.b64decode(words)), "<u4")
        groups.append((round_, generated, fitted, array.reshape(-1, count, 4)))
    return json.loads(data), groups


def test_groups_tell_rounds_and_sources(fitted_run, bare_run, tmp_path, monkeypatch):
    monkeypatch.setattr("pipelines.export.html.MOST_IN_GROUP", 1000)
    for run in (fitted_run, bare_run):
        out = tmp_path / "page.html"
        export_run(run.folder, "html", out)
        data, groups = scene_of(out)
        splats = ExportSource(run.folder, run.memory).splats(ExportOptions(), exposed=False)
        assert sum(words.shape[1] for *_, words in groups) == len(splats)
        assert max(words.shape[1] for *_, words in groups) <= 1000 < len(splats)
        assert {(r, bool(g)) for r, g, *_ in groups} == set(
            zip(splats.rounds.tolist(), splats.generated.tolist(), strict=True)
        )
        positions = np.concatenate([w[0, :, :3].copy().view("<f4") for *_, w in groups])
        where = np.sort((positions + np.float32(0)).view("f4,f4,f4"), axis=0)
        expected = np.sort(np.ascontiguousarray(splats.positions).view("f4,f4,f4"), axis=0)
        np.testing.assert_array_equal(where, expected)
        # Harmonics of fitted ones alone, with the photographs' exposures beside them.
        assert {(fitted, len(w)) for *_, fitted, w in groups} <= {(1, 4), (0, 2)}
        assert (data["exposures"] is not None) == (run is fitted_run)
        export_run(run.folder, "splat", tmp_path / "splats.ply")
        export_run(tmp_path / "splats.ply", "html", tmp_path / "of_file.html")
        assert sum(words.shape[1] for *_, words in scene_of(tmp_path / "of_file.html")[1]) == len(
            splats
        )
        export_run(run.folder, "html", out, "--observed")
        assert not any(generated for _, generated, *_ in scene_of(out)[1])


def test_names_of_files_are_text_alone():
    evil = '</script><img src=x onerror="alert(1)">-->'
    start = PageCamera(Cameras.pinhole(4, 3, focal=3, name=evil))
    group = PageGroup(0, generated=False, fitted=False, words=[np.zeros((1, 4), np.uint32)] * 2)
    page = SharedPage(
        title=evil, summary="", groups=[group], cameras=[start], start=start, origin=np.zeros(3),
        up=np.array([0.0, -1, 0]), depth=1.0, near=0.1,
    )  # fmt: skip
    assert page_html(page).count("<img") == 0


def test_a_folder_whose_name_is_no_text_has_a_page(bare_run, tmp_path):
    folder = tmp_path / os.fsdecode(b"run_\xff")
    try:
        shutil.copytree(bare_run.folder, folder)
    except OSError:
        pytest.skip("this file system takes no such names")
    export_run(folder, "html", tmp_path / "page.html")
    assert "<h1>run_\\udcff</h1>" in (tmp_path / "page.html").read_text("utf-8")


def reaches(browser, state):
    end = time.monotonic() + PATIENCE
    while (now := browser.driver.execute_script("return document.body.dataset.state")) != state:
        assert now != "failed", browser.text()
        assert time.monotonic() < end, f"still {now}"
        time.sleep(0.1)


def still(browser):
    """The window once it has stopped changing."""
    end, last = time.monotonic() + PATIENCE, None
    while True:
        time.sleep(0.6)
        now = browser.picture()
        if last is not None and np.array_equal(now, last):
            return now.astype(float)
        assert time.monotonic() < end
        last = now


@pytest.mark.slow
def test_the_page_shows_what_the_run_does(scene, fitted_run, tmp_path, monkeypatch):
    monkeypatch.setattr("pipelines.export.html.MOST_IN_GROUP", 1000)
    out = tmp_path / "page.html"
    export_run(fitted_run.folder, "html", out)
    camera = scene.views[1].camera
    splats = ExportSource(fitted_run.folder, fitted_run.memory).splats(
        ExportOptions(), exposed=False
    )
    whole = fitted_run.appearance
    fitted = Gaussians(splats.values[: splats.fitted], frame=LocalFrame.at(splats.origin))
    expected = Appearance(
        fitted, near=whole.near, backdrop=whole.backdrop,
    ).picture(camera).rgb * whole.exposures.at(
        whole.gaussians.frame.cam_from_local(camera.cam_from_world)[0]
    )  # fmt: skip
    view = PageCamera(camera).view(splats.origin)
    numbers = ",".join(str(x) for x in (*view["position"], *view["turn"], *view["lens"]))
    with open_browser() as browser:
        browser.resize(int(camera.width[0]), int(camera.height[0]))
        browser.driver.get(f"{out.as_uri()}#v={numbers}&generated=0&bare=1")
        reaches(browser, "shown")
        assert psnr(still(browser) / 255, np.clip(expected, 0, 1)) > 40
        assert browser.console_errors() == [] and browser.foreign_requests() == []


@pytest.mark.slow
def test_a_click_flies_and_the_address_keeps_view_and_choices(fitted_run, tmp_path):
    out = tmp_path / "page.html"
    export_run(fitted_run.folder, "html", out)
    data, _ = scene_of(out)
    goal = data["cameras"][-1]
    with open_browser(width=900, height=600) as browser:
        run = browser.driver.execute_script
        browser.driver.get(out.as_uri())
        reaches(browser, "shown")
        first = still(browser)
        browser.driver.find_elements("css selector", "#photographs button")[-1].click()
        second = still(browser)
        assert not np.array_equal(first, second)
        numbers = run("return location.hash").removeprefix("#v=").split(",")
        np.testing.assert_allclose(
            np.array(numbers, float), [*goal["position"], *goal["turn"], *goal["lens"]], atol=1e-5
        )
        browser.driver.find_element("id", "generated").click()
        time.sleep(0.5)
        kept, third = run("return location.href"), still(browser)
        assert "generated=0" in kept and not np.array_equal(second, third)
        # Keys walk on.
        browser.driver.find_element("css selector", "body").send_keys("w")
        assert not np.array_equal(still(browser), third)
        assert run("return document.getElementById('walk').ariaPressed") == "true"
        browser.driver.get("about:blank")
        browser.driver.get(f"{kept}&round=9")
        reaches(browser, "shown")
        assert psnr(still(browser)[60:, :700] / 255, third[60:, :700] / 255) > 45
        assert "after round 2" in browser.text().replace("\n", " ")
        # In a window of the size that frames have, the scene alone.
        browser.resize(300, 150)
        assert run("return document.getElementById('stage').clientHeight") == 150
        assert browser.console_errors() == [] and browser.foreign_requests() == []


@pytest.mark.slow
def test_without_webgl_a_line_says_so(bare_run, tmp_path):
    out = tmp_path / "page.html"
    export_run(bare_run.folder, "html", out)
    with open_browser() as browser:
        browser.driver.execute_cdp_cmd(
            "Page.addScriptToEvaluateOnNewDocument",
            {"source": "HTMLCanvasElement.prototype.getContext = () => null"},
        )
        browser.driver.get(out.as_uri())
        wait(lambda: "This browser has no WebGL 2" in browser.text())
        assert browser.console_errors() == []
