from __future__ import annotations

import os
import re
import shutil
import socket
import struct
import subprocess
import sys
import threading
import time
import zipfile
from contextlib import contextmanager
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from box_project import write_box
from browser import free_port
from command_line import arguments, refused
from export_runs import Y_UP, export_run, saved_run
from PIL import Image

from gvtools.errors import MemoryFileError, OptionError
from gvtools.glb import join_glb
from gvtools.memory.spatial_memory import SpatialMemory
from gvtools.memory.thinning import thin
from gvtools.splat_files import read_splats
from pipelines.cli import main
from pipelines.commands import view
from pipelines.console import Console
from pipelines.viewing import readers, serve
from pipelines.viewing.source import ViewSource
from viz.viewer.colors import MODES
from viz.viewer.render import chosen_camera, picture_of
from viz.viewer.run_view import MESH, POINTS, RENDERED, SPLATS, TARGET
from viz.viewer.standpoint import camera_outside
from viz.viewer.web import BUDGET, LOCAL, PORT


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    scene = write_box(tmp_path_factory.mktemp("box"))
    return saved_run(scene, tmp_path_factory.mktemp("fitted") / "run", fitted=True)


@pytest.fixture(scope="module")
def exported(run, tmp_path_factory):
    """A file of each format that has one, by its name."""
    folder = tmp_path_factory.mktemp("exported")

    def export(name: str, form: str, *words: object) -> Path:
        export_run(run.folder, form, folder / name, *words)
        return folder / name

    return export


def lie_alike(shown, expected, edge):
    """Whether points of a view are points of the memory, and all of its places are among them."""
    from scipy.spatial import cKDTree

    found = shown.memory.positions
    assert cKDTree(expected).query(found)[0].max() < edge
    assert cKDTree(found).query(expected)[0].max() < 2 * edge


def drawn(shown, most):
    """Positions (N, 3) in the world that the page draws Gaussians at, and its first group."""
    page = shown.page_of(shown, most)
    positions = [group.words[0][:, :3].copy().view("<f4") for group in page.groups]
    return np.concatenate(positions) + page.origin, page.groups[0].words


@pytest.mark.parametrize(
    ("name", "form", "package"),
    [("a.ply", "ply", "open3d"), ("a.las", "las", "laspy"), ("a.laz", "las", "lazrs"),
     ("a.usdc", "usd", "pxr"), ("a.usda", "usd", "pxr"), ("a.glb", "glb", "trimesh")],
)  # fmt: skip
def test_points_lie_where_they_were_in_their_colours(run, exported, name, form, package):
    pytest.importorskip(package)
    shown = ViewSource(exported(name, form)).read()
    assert POINTS in shown.looks and RENDERED in shown.looks
    rows = thin(run.memory, None).rows
    lie_alike(shown, run.memory.positions[rows], run.memory.voxel)
    colors = run.memory.columns.colors[rows].astype(float).mean(axis=0)
    there = shown.memory.columns.colors[: len(shown.memory)].astype(float).mean(axis=0)
    np.testing.assert_allclose(there, colors, atol=6)


@pytest.mark.parametrize("name", ["m.ply", "m.glb", "m.obj"])
def test_meshes_have_their_triangles_and_colours(run, exported, name):
    trimesh = pytest.importorskip("trimesh")
    file = exported(name, "mesh", *Y_UP)
    shown = ViewSource(file).read()
    assert shown.looks == (MESH, POINTS)
    surface = shown.surface
    assert surface is not None
    # A GLB stands upright for trimesh; in the input's axes, as a PLY's, it is shown.
    plain_file = exported("plain.ply", "mesh") if name == "m.glb" else file
    plain = trimesh.load_scene(plain_file, process=False).to_mesh()
    assert surface.faces.shape == plain.faces.shape
    np.testing.assert_allclose(surface.vertices, plain.vertices, atol=1e-6)
    # They come from the run's own colours, none of which is grey.
    low, high = (run.memory.columns.colors.min(axis=0), run.memory.columns.colors.max(axis=0))
    assert ((surface.colors >= low - 2) & (surface.colors <= high + 2)).all()
    assert np.ptp(surface.colors, axis=0).max() > 50
    lie_alike(shown, surface.vertices, 4 * shown.memory.voxel)


@pytest.mark.parametrize(("name", "off"), [("s.ply", 1e-6), ("s.spz", 2e-3)])
def test_splats_are_those_of_the_export(exported, name, off):
    gsply = pytest.importorskip("gsply")
    shown = ViewSource(exported(name, "splat")).read()
    assert shown.looks == (SPLATS, POINTS)
    centers, words = drawn(shown, 10)
    plain = gsply.plyread(exported("reference.ply", "splat"))
    np.testing.assert_allclose(centers, plain.means, atol=off)
    # Harmonics, too.
    assert len(words) == 4


@pytest.mark.parametrize("case", ["array", "count", "copies"])
def test_a_glb_that_claims_more_than_it_holds_is_refused(tmp_path, case):
    pytest.importorskip("trimesh")
    body = np.random.default_rng(0).normal(size=(999, 3)).astype("<f4").tobytes()
    count = 10**9 if case == "count" else 999
    array = {"componentType": 5126, "type": "VEC3", "count": count, "bufferView": 0}
    if case == "array":
        del array["bufferView"]
    nodes = [{"mesh": 0}] * (5000 if case == "copies" else 1)
    tree = {
        "asset": {"version": "2.0"}, "buffers": [{"byteLength": len(body)}],
        "bufferViews": [{"buffer": 0, "byteLength": len(body)}], "accessors": [array],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "mode": 0}]}], "nodes": nodes,
        "scenes": [{"nodes": list(range(len(nodes)))}], "scene": 0,
    }  # fmt: skip
    said = {"array": "without data", "count": "items", "copies": "nodes draw"}[case]
    with pytest.raises(MemoryFileError, match=said):
        (tmp_path / "a.glb").write_bytes(join_glb(tree, body))
        ViewSource(tmp_path / "a.glb").read()


def test_a_usd_that_names_other_files_is_refused(tmp_path):
    pytest.importorskip("pxr")
    (tmp_path / "a.usda").write_text(
        '#usda 1.0\n(\n    subLayers = [@../secret.usda@]\n)\ndef Points "p"\n{\n'
        "    point3f[] points = [(0, 0, 0)]\n}\n"
    )
    with pytest.raises(MemoryFileError, match="names other files"):
        ViewSource(tmp_path / "a.usda").read()


def test_damaged_files_are_named_in_one_line(exported, tmp_path, capsys):
    for name, form in (("a.ply", "splat"), ("a.laz", "las"), ("m.glb", "mesh"), ("a.usdc", "usd")):
        whole = exported(name, form).read_bytes()
        file = tmp_path / name
        file.write_bytes(whole[: len(whole) // 2])
        assert str(file) in refused(capsys, "view", file)
    (tmp_path / "t.obj").write_text("# nothing\n")
    assert "expected" in refused(capsys, "view", tmp_path / "t.obj")
    (tmp_path / "empty.spz").touch()
    assert "empty.spz" in refused(capsys, "view", tmp_path / "empty.spz")
    assert "no such file" in refused(capsys, "view", tmp_path / "absent.spz")


def test_a_package_that_is_not_there_is_named(exported, monkeypatch, capsys):
    file = exported("a.las", "las")
    monkeypatch.setitem(sys.modules, "laspy", None)
    said = refused(capsys, "view", file)
    assert "laspy" in said and "gvtools[export]" in said


def test_a_recording_goes_to_reruns_own_viewer(tmp_path, monkeypatch, capsys):
    file = tmp_path / "-run.rrd"
    assert "no such file" in refused(capsys, "view", tmp_path / "absent.rrd")
    line = refused(capsys, "view", file, "--screenshot", tmp_path / "a.png")
    assert "rerun's own viewer" in line and "--screenshot: " in line
    file.write_bytes(b"RRF2")
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python"))
    monkeypatch.setenv("PATH", "")
    assert "not installed" in refused(capsys, "view", file)
    told = tmp_path / "told"
    program = tmp_path / "rerun"
    program.write_text(f'#!/bin/sh\necho "$@" > {told}\n')
    program.chmod(0o755)
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    assert main(["view", str(file), "--port", "9191"]) == 0
    expected = f"{file} --bind 127.0.0.1 --web-viewer --web-viewer-port 9191"
    assert told.read_text().split() == expected.split()
    monkeypatch.setenv("DISPLAY", ":0")
    assert main(["view", str(file)]) == 0
    assert told.read_text().split() == f"{file} --bind 127.0.0.1".split()
    program.write_text("#!/bin/sh\nexit 3\n")
    assert "status 3" in refused(capsys, "view", file)


def test_a_runs_gaussians_are_those_of_its_export(run, exported):
    shown = ViewSource(run.folder).read()
    assert shown.looks == (POINTS, SPLATS, RENDERED)
    file = read_splats(exported("whole.ply", "splat"))
    np.testing.assert_allclose(drawn(shown, 10**6)[0], file.positions, atol=1e-6)
    assert shown.page_of is not None
    groups = shown.page_of(shown, 10**6).groups
    generated = run.memory.columns.round[: len(run.memory)][run.memory.generated]
    assert {group.round for group in groups if group.fitted} == {0}
    assert {g.round for g in groups if g.generated} == set(generated.tolist()) != {0}
    assert any(camera.kind == TARGET for camera in shown.cameras)
    # The fit stays whole, however few points are wanted.
    fitted = len(run.appearance.gaussians)
    assert fitted < len(drawn(shown, 20)[0]) <= fitted + 20


@pytest.mark.parametrize(
    ("name", "form"),
    [("up.ply", "ply"), ("mesh.ply", "mesh"), ("mesh.obj", "mesh"), ("mesh.glb", "mesh"),
     ("up.glb", "glb"), ("splats.glb", "splat"), ("up.usda", "usd")],
)  # fmt: skip
def test_what_a_file_says_is_up_is_up(exported, name, form):
    shown = ViewSource(exported(name, form, "--up", 0, -3, 4)).read()
    np.testing.assert_allclose(shown.up(), [0, -0.6, 0.8], atol=1e-12)


@pytest.mark.parametrize(
    ("name", "form"), [("look.ply", "splat"), ("look.glb", "mesh"), ("look.las", "las")]
)
def test_a_picture_of_a_file_shows_it_whole_from_outside(exported, tmp_path, name, form):
    file, shot = exported(name, form), tmp_path / "shot.png"
    assert main(["view", str(file), "--screenshot", str(shot), "--quiet"]) == 0
    picture = np.array(Image.open(shot))
    painted = picture.min(axis=2) < 250
    assert painted.mean() > 0.02
    # Nothing is cut off.
    assert not painted[[0, -1]].any()
    assert not painted[:, [0, -1]].any()
    run = ViewSource(file).read()
    down = camera_outside(run).cam_from_world[0, 1, :3]
    assert down @ run.up() < 0, "up is upwards in the picture"
    with pytest.raises(OptionError, match="holds no cameras"):
        chosen_camera(run, "a.png")


TRIANGLE = """mtllib m.mtl
usemtl a
v 0 0 0
v 1 0 0
v 0 1 0
vt 0 0
vt 1 0
vt 0 1
f 1/1 2/2 3/3
"""


def test_a_texture_is_measured_by_its_own_file(tmp_path, monkeypatch):
    monkeypatch.setattr(readers, "PIXEL_BYTES", 0)
    noise = np.random.default_rng(0).integers(0, 255, (256, 256, 3), np.uint8)
    (tmp_path / "m.mtl").write_text("newmtl a\nmap_Kd t%201.png\n")
    (tmp_path / "m.obj").write_text(TRIANGLE)
    with pytest.raises(MemoryFileError, match=r"its picture 't%201.png' is absent"):
        readers.load_mesh(tmp_path / "m.obj")
    Image.fromarray(noise).save(tmp_path / "t 1.png")
    before = Image.MAX_IMAGE_PIXELS
    mesh: Any = readers.load_mesh(tmp_path / "m.obj")
    assert mesh.visual.material.image.size == (256, 256)
    assert before == Image.MAX_IMAGE_PIXELS


def test_a_mesh_of_gltf_opens_with_its_colors(tmp_path):
    import trimesh

    box = trimesh.creation.box()
    box.visual.vertex_colors = np.arange(32, dtype=np.uint8).reshape(8, 4)
    for name, data in trimesh.exchange.gltf.export_gltf(box.scene()).items():
        (tmp_path / name).write_bytes(data)
    surface: Any = ViewSource(tmp_path / "model.gltf").read().surface
    order = np.lexsort(surface.vertices.T)
    np.testing.assert_allclose(surface.vertices[order], box.vertices[np.lexsort(box.vertices.T)])
    assert surface.colors[order].tolist() == (
        box.visual.vertex_colors[np.lexsort(box.vertices.T), :3].tolist()
    )


def test_a_single_gaussian_opens_at_its_own_size(tmp_path):
    row = np.array([(1, 2, 3), (0.5, 0.5, 0.5)], "<f4").tobytes() + bytes([200] * 8)
    (tmp_path / "one.splat").write_bytes(row)
    shown = ViewSource(tmp_path / "one.splat").read()
    np.testing.assert_allclose(shown.memory.positions, [[1, 2, 3]])
    assert shown.memory.voxel == pytest.approx(0.5)


def test_a_glb_of_more_than_a_million_points_opens(tmp_path):
    import trimesh

    points = np.random.default_rng(0).random((1_200_000, 3), np.float32)
    trimesh.PointCloud(points).export(tmp_path / "p.glb")
    assert len(readers.load_mesh(tmp_path / "p.glb").vertices) == 1_200_000


NEWER = {
    "a.spz": b"NGSP" + struct.pack("<II4B", 5, 10, 3, 12, 0, 0) + bytes(99),
    "a.glb": b"glTF" + struct.pack("<II", 3, 99) + bytes(99),
    "a.las": b"LASF" + bytes(20) + bytes([1, 5]) + bytes(400),
}


@pytest.mark.parametrize("name", NEWER)
def test_newer_files_are_named_as_such(tmp_path, capsys, name):
    (tmp_path / name).write_bytes(NEWER[name])
    said = refused(capsys, "view", tmp_path / name, "--screenshot", tmp_path / "a.png")
    assert "version" in said and "newer than this program" in said


def test_a_newer_memory_asks_for_a_newer_program(tmp_path, capsys):
    with zipfile.ZipFile(tmp_path / "memory.npz", "w") as archive:
        archive.writestr("header.json", '{"format": "gvtools memory", "version": 99}')
    said = refused(capsys, "view", tmp_path / "memory.npz", "--screenshot", tmp_path / "a.png")
    assert "99" in said and "update gvtools" in said


@pytest.mark.parametrize(
    ("words", "opened"),
    [
        (("view", "{}", "--screenshot", "{}.png"), ".npz, .ply"),
        (("export", "{}", "--format", "ply", "--out", "{}.ply"), ".npz, .ply"),
        (("check", "{}"), "transforms.json"),
        (("reconstruct", "{}", "--out", "{}.out"), "transforms.json"),
    ],
)
def test_unknown_suffixes_list_what_opens(tmp_path, capsys, words, opened):
    file = tmp_path / "a.rar"
    file.write_bytes(b"PK\x03\x04" + bytes(99))
    assert opened in refused(capsys, *(word.format(file) for word in words))
    assert list(tmp_path.iterdir()) == [file]


CAMERA = "frame-000004.color.png"


@contextmanager
def display(tmp_path):
    """An X server without a screen; skipped, with the reason, where there is none."""
    if shutil.which("Xvfb") is None:
        pytest.skip("no Xvfb (Debian: xvfb)")
    read, write = os.pipe()
    command = ["Xvfb", "-displayfd", str(write), "-screen", "0", "1280x800x24", "-nolisten", "tcp"]
    with (tmp_path / "xvfb.log").open("wb") as log:
        server = subprocess.Popen(command, pass_fds=[write], stderr=log)
    os.close(write)
    try:
        with os.fdopen(read) as told:
            yield f":{told.readline().strip()}"
    finally:
        server.terminate()
        server.wait()


def test_the_parser_knows_what_the_viewers_know():
    args = arguments("view", "run")
    assert (args.host, args.port, args.max_points) == (LOCAL, PORT, BUDGET)
    assert LOCAL == "127.0.0.1"
    assert tuple(MODES) == get_args(view.ViewCommand.model_fields["color"].annotation)


def test_a_picture_needs_no_display(small_run, tmp_path, monkeypatch, capsys):
    monkeypatch.delenv("DISPLAY", raising=False)
    out = tmp_path / "shot.png"
    options = ("--screenshot", str(out), "--camera", CAMERA, "--round", "1")
    assert main(["view", str(small_run), *options]) == 0
    assert f"round 1 from {CAMERA}" in capsys.readouterr().out
    memory = SpatialMemory.load(small_run / "memory.npz")
    memory.forget(round=2)
    row = next(i for i in range(len(memory.views)) if memory.views[i].camera.names[0] == CAMERA)
    expected = picture_of(memory.project(memory.views[row].camera))
    np.testing.assert_array_equal(np.array(Image.open(out)), expected)


def test_bad_options_are_refused_in_one_line(small_run, tmp_path, monkeypatch, capsys):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    words = ("view", small_run)
    shot = ("--screenshot", tmp_path / "x.png")
    assert "no such file or folder" in refused(capsys, "view", tmp_path / "absent", *shot)
    assert "such as 'frame-000000" in refused(capsys, *words, *shot, "--camera", "nobody")
    assert "rounds 0 to 2" in refused(capsys, *words, "--round", "3")
    assert "ends with .png" in refused(capsys, *words, "--screenshot", tmp_path / "x.jpg")
    assert "no display" in refused(capsys, *words, "--open3d")
    assert "--live" in refused(capsys, *words, "--live", *shot)
    assert "at most 65535" in refused(capsys, *words, "--port", "99999")
    # 192.0.2.1 is nobody's, by RFC 5737.
    assert "cannot listen" in refused(capsys, *words, "--host", "192.0.2.1")
    assert not (tmp_path / "x.png").exists()


@pytest.mark.slow
def test_the_open3d_window_shows_the_run_and_steps_through_it(small_run, tmp_path):
    code = f"""
from pathlib import Path
import numpy as np
from pipelines.viewing.source import ViewSource
from viz.viewer.window import Open3dViewer

said = []
viewer = Open3dViewer(ViewSource(Path({str(small_run)!r})).read(), say=said.append)
viewer.look_from(0)
def look():
    for _ in range(3):
        viewer.window.poll_events()
        viewer.window.update_renderer()
    return np.rint(255 * np.asarray(viewer.window.capture_screen_float_buffer(True))).astype("u1")
pictures = [look()]
viewer.step_round(-2)
pictures.append(look())
viewer.step_round(2)
viewer.next_mode()
pictures.append(look())
viewer.toggle_cameras()
pictures.append(look())
viewer.look_from(4)
viewer.window.destroy_window()
np.save({str(tmp_path / "pictures.npy")!r}, pictures)
print("\\n".join(said))
"""
    with display(tmp_path) as name:
        environment = {**os.environ, "DISPLAY": name, "LIBGL_ALWAYS_SOFTWARE": "1"}
        done = subprocess.run(
            [sys.executable, "-c", code], env=environment, capture_output=True, text=True,
            timeout=120, check=False,
        )  # fmt: skip
    if "GLFW" in done.stderr and done.returncode:
        pytest.skip("the X server has no OpenGL (Debian: libgl1-mesa-dri)")
    assert done.returncode == 0, done.stderr
    last, first, colored, bare = np.load(tmp_path / "pictures.npy").astype(int)
    covered = [(picture < 250).any(axis=2).mean() for picture in (first, last)]
    assert covered[1] > covered[0] > 0.05
    assert np.abs(colored - last).mean() > 3 and (bare != colored).any()
    lines = done.stdout.splitlines()
    assert lines[0].startswith("round 0 of 2") and "0 generated" in lines[0]
    assert lines[2].startswith("round 2 of 2") and "round: round that" in lines[2]


def test_the_live_viewer_is_there_as_long_as_the_run_is_at_work(
    small_run, tmp_path, capsys, monkeypatch
):
    pytest.importorskip("viser", reason="viser is not installed")
    begun: list[subprocess.Popen] = []

    class Noted(subprocess.Popen):
        def __init__(self, *words: Any, **options: Any) -> None:
            super().__init__(*words, **options)
            begun.append(self)

    monkeypatch.setattr(subprocess, "Popen", Noted)
    port = free_port()
    later = tmp_path / "run"
    threading.Timer(0.3, shutil.copytree, (small_run, later)).start()

    def reached() -> bool:
        with socket.socket() as probe:
            return probe.connect_ex(("127.0.0.1", port)) == 0

    with serve.live_viewer(later, Console(), "--port", str(port)):
        end = time.monotonic() + 60
        while not reached():
            assert time.monotonic() < end
            time.sleep(0.02)
        # Told by this process, whose progress bar it has to go around.
        said = ""
        while f"{later}: look at http://127.0.0.1:{port} (Ctrl-C ends)\n" not in said:
            assert time.monotonic() < end
            time.sleep(0.02)
            said += capsys.readouterr().out
        # It starts without what takes seconds to import.
        maps = Path(f"/proc/{begun[0].pid}/maps")
        loaded = maps.read_text() if maps.exists() else ""
        assert "numba" in loaded or not loaded
        assert not re.search(r"/(torch|matplotlib)/", loaded)
    assert not reached()


def test_a_run_that_fails_at_once_says_no_more_than_why(tmp_path, capfd):
    with pytest.raises(OptionError), serve.live_viewer(tmp_path / "run", Console()):
        # While the viewer is still starting.
        time.sleep(0.3)
        raise OptionError("no such project")
    said = capfd.readouterr()
    assert "Traceback" not in said.err and "KeyboardInterrupt" not in said.err


@pytest.mark.parametrize("report", ["", '{"round": 2,', "[]", '{"round": 2, "views": []}'])
def test_a_round_that_came_meanwhile_is_shown_once_its_report_is_whole(
    small_run, tmp_path, capsys, report
):
    growing, kept = tmp_path / "growing", tmp_path / "kept"
    shutil.copytree(small_run, growing)
    (growing / "round_002").rename(kept)
    source, rounds = ViewSource(growing), list[int]()
    following = serve.Following(
        source, source.read(), lambda run: rounds.append(run.last_round), console=Console()
    )
    if report:
        (growing / "round_002").mkdir()
        (growing / "round_002" / "report.json").write_text(report)
        for _ in range(3):
            following.look()
        said = capsys.readouterr().err
        assert len(said.splitlines()) == 1 and "round_002" in said
        shutil.rmtree(growing / "round_002")
    kept.rename(growing / "round_002")
    following.look()
    following.look()
    assert rounds == [2]
    assert capsys.readouterr().out == "round 2 is there\n"
