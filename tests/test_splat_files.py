"""Splats written in every format, as other packages and the one reader see them."""

from __future__ import annotations

import base64
import json
from dataclasses import replace
from typing import Any
from zipfile import ZipFile

import numpy as np
import pytest
from command_line import refused, run_command
from numpy.lib.recfunctions import repack_fields
from PIL import Image
from plyfile import PlyData, PlyElement
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from gvtools.errors import GvError, MemoryFileError
from gvtools.glb import glb_array, join_glb, split_glb
from gvtools.scans.read import read_scan
from gvtools.splat_files import holds_splats, read_splats
from gvtools.splats import HARMONICS, SH, TERMS, TO_RUB, Splats, place_gaussians, turn_gaussians
from pipelines.export.formats import ExportOptions
from pipelines.export.splats import write_file

COUNT = 300
# How far positions, logarithms of sizes, opacities and colours may be from what was written, and
# harmonics above degree 0; None where the format has none.
ERRORS = {
    ".ply": (0, 0, 1e-6, 0, 0),
    ".compressed.ply": (0.01, 0.01, 0.003, 0.01, 0.02),
    ".spz": (1e-3, 0.04, 0.003, 0.007, 0.07),
    ".sog": (2e-3, 0.05, 0.005, 0.007, 0.02),
    ".splat": (0, 1e-6, 0.005, 0.005, None),
    ".ksplat": (0, 1e-6, 0.005, 0.005, 1e-6),
    ".glb": (1e-6, 1e-6, 1e-6, 0, 0),
    ".usdc": (1e-6, 1e-6, 1e-6, 0, 0),
    ".usda": (1e-5, 1e-5, 1e-5, 1e-5, 1e-5),
}
NEEDS = {".compressed.ply": "gaussforge", ".spz": "gaussforge", ".sog": "gaussforge",
         ".ksplat": "gaussforge", ".usdc": "pxr.UsdVol", ".usda": "pxr.UsdVol"}  # fmt: skip


def some(degree=3):
    rng = np.random.default_rng(degree)
    values = rng.normal(size=(COUNT, SH + 3 * TERMS[degree]))
    values[:, 3:6] = values[:, 3:6] * 0.5 - 4
    # Colours from 0 to 1, which 8 bits hold.
    values[:, SH : SH + 3] = rng.uniform(-1.7, 1.7, (COUNT, 3))
    values[:, SH + 3 :] *= 0.2
    rounds, up = np.zeros(COUNT, np.int32), np.array([0.0, -0.6, 0.8])
    return Splats(values.astype(np.float32), np.zeros(3), COUNT, 0, rounds, rounds > 0, up)


def written(folder, end, splats, **options):
    if end in NEEDS:
        pytest.importorskip(NEEDS[end])
    write_file(splats, folder / f"a{end}", ExportOptions(**options))
    return folder / f"a{end}"


def check_alike(found, given, errors):
    assert len(found) == len(given)
    world = found.positions + found.origin
    place = cKDTree(world).query(given.positions + given.origin)[1]
    assert len({*place}) == len(given)
    rows = found.values[place]
    near, size, opacity, color, rest = errors
    np.testing.assert_allclose(world[place], given.positions + given.origin, atol=near)
    np.testing.assert_allclose(rows[:, 3:6], given.log_scales, atol=size)
    same = np.abs((found.quaternions[place] * given.quaternions).sum(axis=1))
    np.testing.assert_allclose(same, 1, atol=1e-4)
    np.testing.assert_allclose(found.opacities[place], given.opacities, atol=opacity)
    np.testing.assert_allclose(found.colors[place], given.colors, atol=color)
    if rest is None:
        assert found.degree == 0
    else:
        ours = given.harmonics[:, : found.harmonics.shape[1]]
        np.testing.assert_allclose(found.harmonics[place][:, 1:], ours[:, 1:], atol=rest)


@pytest.mark.parametrize("degree", [0, 3])
@pytest.mark.parametrize("end", ERRORS)
def test_what_is_written_is_read(tmp_path, end, degree):
    given = some(degree)
    found = read_splats(written(tmp_path, end, given))
    check_alike(found, given, ERRORS[end])
    assert found.degree == min(degree, {".splat": 0, ".ksplat": 2}.get(end, 3))
    if end in (".ply", ".compressed.ply", ".glb", ".usdc", ".usda"):
        assert found.up == pytest.approx(given.up, abs=1e-6)


@pytest.mark.parametrize(
    ("end", "version"),
    [(".spz", 4), pytest.param(".spz", 3, marks=pytest.mark.slow), (".compressed.ply", 4)],
)
def test_gsply_reads_the_same(tmp_path, end, version):
    gsply, given = pytest.importorskip("gsply"), some()
    file = written(tmp_path, end, given, spz_version=version)
    read = gsply.read_spz(file) if end == ".spz" else gsply.plyread(file)
    parts = (read.means, read.scales, read.quats, np.reshape(read.opacities, (COUNT, 1)), read.sh0)
    values = np.concatenate([*parts, np.reshape(read.shN, (COUNT, -1))], axis=1)
    values = turn_gaussians(values, TO_RUB) if end == ".spz" else values
    check_alike(replace(given, values=values), given, ERRORS[end])


@pytest.mark.slow
def test_spz_is_read_without_gaussforge(tmp_path, monkeypatch):
    file = written(tmp_path, ".spz", some())
    one = read_splats(file)
    monkeypatch.setattr("gvtools.splat_files.installed", lambda name: False)
    np.testing.assert_allclose(read_splats(file).values, one.values, atol=1e-5)


def test_a_glb_shows_linear_colors_and_its_node_moves_turns_and_scales(tmp_path):
    file, given = written(tmp_path, ".glb", some()), some()
    turn = Rotation.from_rotvec([0.3, -1.0, 0.5])
    tree, body = split_glb(file.read_bytes())
    shown = glb_array(tree, body, tree["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"])
    bright = given.colors > 0.0404
    expected = ((given.colors + 0.055) / 1.055) ** 2.4
    np.testing.assert_allclose(shown[:, :3][bright], expected[bright], atol=1e-5)
    tree["nodes"][0] |= {"rotation": turn.as_quat().tolist(), "scale": [2, 2, 2]}
    moved = np.array(tree["nodes"][0]["translation"])
    file.write_bytes(join_glb(tree, body))
    matrix = np.eye(4)
    matrix[:3, :3] = 2 * turn.as_matrix()
    values = given.values.copy()
    values[:, :3] -= moved
    values, _ = place_gaussians(values, matrix)
    found = read_splats(file)
    check_alike(found, replace(given, values=values, origin=moved), (1e-5, 1e-5, 1e-5, 1e-5, 1e-4))


@pytest.mark.parametrize("embedded", [True, False])
def test_gltf_with_its_bytes_inside_or_beside_it(tmp_path, capsys, embedded):
    """Of two buffers, the second is beside the file in any case, under a name with a blank."""
    file, given = written(tmp_path, ".glb", some()), some()
    tree, body = split_glb(file.read_bytes())
    data = "data:application/octet-stream;base64," + base64.b64encode(body).decode()
    (tmp_path / "a b.bin").write_bytes(body)
    uris = (data if embedded else "first.bin", "a%20b.bin")
    tree["buffers"] = [{"uri": uri, "byteLength": len(body)} for uri in uris]
    for number, view in enumerate(tree["bufferViews"]):
        view["buffer"] = number % 2
    text = tmp_path / "a.gltf"
    text.write_text(json.dumps(tree))
    if not embedded:
        with pytest.raises(GvError, match=r"'first.bin': no such file; expected a file beside it"):
            read_splats(text)
        (tmp_path / "first.bin").write_bytes(body)
    assert holds_splats(text)
    check_alike(read_splats(text), given, ERRORS[".glb"])
    said = refused(capsys, "export", text, "--out", tmp_path / "b.gltf")
    assert "or an end that is written: .glb" in said


def test_sparse_arrays_of_a_glb_and_what_no_scene_shows(tmp_path):
    file, given = written(tmp_path, ".glb", some(1)), some(1)
    tree, body = split_glb(file.read_bytes())
    # Positions from 0, of which each is told; a second node that the scene leaves out.
    accessor = tree["accessors"][0]
    tree["bufferViews"].append({"buffer": 0, "byteOffset": len(body), "byteLength": 2 * COUNT})
    body += np.arange(COUNT, dtype="<u2").tobytes()
    rows = {"bufferView": len(tree["bufferViews"]) - 1, "componentType": 5123}
    values = {"bufferView": accessor.pop("bufferView")}
    accessor["sparse"] = {"count": COUNT, "indices": rows, "values": values}
    tree["nodes"].append({"mesh": 0, "translation": [50, 0, 0]})
    file.write_bytes(join_glb(tree, body))
    check_alike(read_splats(file), given, ERRORS[".glb"])
    tree["nodes"][0]["children"] = [0]
    file.write_bytes(join_glb(tree, body))
    with pytest.raises(MemoryFileError, match="a node in several places"):
        read_splats(file)


@pytest.mark.parametrize(
    ("end", "mode"),
    [(".ply", "mip"), (".ply", "2dgs"), (".spz", "mip"), (".compressed.ply", "mip"),
     (".sog", "mip")],
)  # fmt: skip
def test_how_to_draw_them_is_kept(tmp_path, end, mode):
    assert read_splats(written(tmp_path, end, replace(some(1), mode=mode))).mode == mode


@pytest.mark.parametrize(("order", "text"), [("<", False), (">", False), ("<", True)])
def test_a_ply_of_another_writer(tmp_path, order, text):
    """Doubles far from 0, its properties sorted, either byte order or text, cameras behind."""
    file, given, far = written(tmp_path, ".ply", some()), some(), np.array([4e5, 5e6, 100])
    rows = PlyData.read(file)["vertex"].data
    table = np.empty(COUNT, [(name, "f8") for name in sorted(rows.dtype.names)])
    for name in rows.dtype.names:
        table[name] = rows[name] + (far["xyz".index(name)] if name in "xyz" else 0)
    camera = np.ones(2, [("fx", "f4")])
    parts = [PlyElement.describe(table, "vertex"), PlyElement.describe(camera, "camera")]
    PlyData(parts, text=text, byte_order=order).write(tmp_path / "b.ply")
    found = read_splats(tmp_path / "b.ply")
    check_alike(found, replace(given, origin=far), (2e-6, 1e-6, 1e-6, 1e-6, 1e-6))
    if text:
        data = (tmp_path / "b.ply").read_bytes().rpartition(b"\n1")[0].rpartition(b"\n")[0]
        (tmp_path / "c.ply").write_bytes(data.rpartition(b"\n")[0])
        with pytest.raises(MemoryFileError, match=f"{COUNT - 1} lines of numbers, but"):
            read_splats(tmp_path / "c.ply")


def write_first_sog(folder, given):
    """SOG of version 1, as the package sogs wrote it: ranges instead of codebooks."""
    side = 20
    meta: dict[str, dict[str, Any]] = {part: {} for part in ("quats", "scales", "sh0", "shN")}
    meta["means"] = {"shape": [COUNT, 3]}

    def save(part, name, stored):
        picture = np.zeros((side * side, stored.shape[1]), np.uint8)
        picture[:COUNT] = stored
        Image.fromarray(picture.reshape(side, side, -1)).save(folder / name, lossless=True, exact=1)
        meta[part]["files"] = [*meta[part].get("files", ()), name]

    def stored(part, values, most=255):
        low, high = (values.min(axis=0), values.max(axis=0))
        meta[part] |= {"mins": low.tolist(), "maxs": high.tolist()}
        return np.rint((values - low) / (high - low) * most).astype(int)

    means = stored("means", np.sign(given.positions) * np.log1p(np.abs(given.positions)), 65535)
    save("means", "means_l.webp", means & 255)
    save("means", "means_u.webp", means >> 8)
    save("scales", "scales.webp", stored("scales", given.log_scales))
    colors = np.concatenate([given.harmonics[:, 0], given.logits[:, None]], axis=1)
    save("sh0", "sh0.webp", stored("sh0", colors))
    q = given.quaternions
    place = np.abs(q).argmax(axis=1)
    q = q * np.sign(q[np.arange(COUNT), place])[:, None]
    rest = q[np.arange(4) != place[:, None]].reshape(-1, 3) * np.sqrt(0.5) + 0.5
    save("quats", "quats.webp", np.column_stack([np.rint(rest * 255), 252 + place]))
    low, high = float(given.harmonics[:, 1:].min()), float(given.harmonics[:, 1:].max())
    meta["shN"] |= {"mins": low, "maxs": high, "files": ["c.webp"]}
    palette = np.zeros((320, 15, 3), np.uint8)
    palette[:COUNT] = np.rint((given.harmonics[:, 1:] - low) / (high - low) * 255)
    Image.fromarray(palette.reshape(5, -1, 3)).save(folder / "c.webp", lossless=True)
    save("shN", "l.webp", np.stack((*np.divmod(np.arange(COUNT), 256)[::-1], 0 * place), axis=1))
    (folder / "meta.json").write_text(json.dumps(meta))


def test_sog_of_version_1_in_a_folder_and_zipped(tmp_path):
    given = some()
    write_first_sog(tmp_path, given)
    with ZipFile(tmp_path / "a.sog", "w") as out:
        for file in tmp_path.glob("*.[wj]*"):
            out.write(file, file.name)
    for path in (tmp_path, tmp_path / "meta.json", tmp_path / "a.sog"):
        found = read_splats(path)
        check_alike(found, given, (1e-4, 0.02, 0.01, 0.005, 0.01))
        assert found.degree == 3
    meta = json.loads((tmp_path / "meta.json").read_text())
    meta["means"]["shape"][0] = 2_000_000
    Image.new("RGB", (2000, 1000)).save(tmp_path / "means_l.webp", lossless=True)
    (tmp_path / "meta.json").write_text(json.dumps(meta))
    with pytest.raises(MemoryFileError, match="2000000 Gaussians in"):
        read_splats(tmp_path)
    meta["means"]["files"][0] = "../a.webp"
    (tmp_path / "meta.json").write_text(json.dumps(meta))
    with pytest.raises(GvError, match="lies outside of"):
        read_splats(tmp_path)


def test_a_file_is_converted_and_the_suffix_tells_the_format(tmp_path, capsys):
    file = written(tmp_path, ".ply", some())
    run_command("export", file, "--out", tmp_path / "b.glb", quiet=True)
    np.testing.assert_allclose(read_splats(tmp_path / "b.glb").values[:, 3:6],
                               some().log_scales, atol=1e-6)  # fmt: skip
    run_command("export", file, "--out", tmp_path / "b.html", "--up", 0, 0, -1, quiet=True)
    assert '"up": [0.0, 0.0, -1.0]' in (tmp_path / "b.html").read_text()
    said = refused(capsys, "export", file, "--out", tmp_path / "c.las")
    assert "holds Gaussians" in said and "give --format splat" in said
    said = refused(capsys, "export", file, "--out", tmp_path / "b.spz", "--up", 0, 1, 0)
    assert "a .spz has no place for it" in said
    said = refused(capsys, "export", file, "--out", tmp_path / "c.ply", "--observed")
    assert "--observed" in said and "leave it out" in said
    said = refused(capsys, "export", file, "--out", tmp_path / "c.sog", "--spz-version", "3")
    assert "is no .spz" in said
    assert "give --format" in refused(capsys, "export", tmp_path, "--out", tmp_path / "c.usdc")


@pytest.mark.parametrize("end", [".splat", ".compressed.ply"])
def test_splats_are_scans(tmp_path, end):
    given = some(0)
    scan = read_scan(written(tmp_path, end, given))
    chosen = given.logits > 0.02
    away, place = cKDTree(scan.positions + scan.origin).query(given.positions[chosen])
    assert away.max() < 0.01 and len(scan.positions) <= (given.logits > -0.02).sum()
    colors = 255 * given.colors[chosen]
    np.testing.assert_allclose(scan.colors[place], colors, atol=3)


def test_flat_gaussians_have_two_sizes(tmp_path):
    """As 2D Gaussian Splatting writes them."""
    file, given = written(tmp_path, ".ply", some()), some()
    rows = PlyData.read(file)["vertex"].data
    rows = repack_fields(rows[[name for name in rows.dtype.names if name != "scale_2"]])
    PlyData([PlyElement.describe(rows, "vertex")]).write(tmp_path / "b.ply")
    found = read_splats(tmp_path / "b.ply")
    assert found.mode == "2dgs"
    np.testing.assert_array_equal(found.log_scales[:, :2], given.log_scales[:, :2])
    assert (found.log_scales[:, 2] < given.log_scales[:, :2].min(axis=1) - 6).all()
    np.testing.assert_array_equal(found.harmonics, given.harmonics)


@pytest.mark.parametrize("degree", [0, 3])
def test_compressed_ply_from_before_ranges_of_colors(tmp_path, degree):
    file = written(tmp_path, ".compressed.ply", some(degree))
    chunk, *behind = PlyData.read(file).elements
    ranges = [chunk.data[f"{end}_{color}"][0] for end in ("min", "max") for color in "rgb"]
    names = [name for name in chunk.data.dtype.names if name[-2:] not in ("_r", "_g", "_b")]
    older = PlyElement.describe(repack_fields(chunk.data[names]), "chunk")
    expected = read_splats(file)
    PlyData([older, *behind]).write(tmp_path / "b.compressed.ply")
    found = read_splats(tmp_path / "b.compressed.ply")
    np.testing.assert_array_equal(found.values[:, :SH], expected.values[:, :SH])
    np.testing.assert_array_equal(found.harmonics[:, 1:], expected.harmonics[:, 1:])
    # The first chunk's bytes, which count from 0 to 1 instead of within its ranges.
    low, high = np.split(np.array(ranges), 2)
    share = (0.5 + HARMONICS[0] * expected.harmonics[:256, 0] - low) / (high - low)
    np.testing.assert_allclose(0.5 + HARMONICS[0] * found.harmonics[:256, 0], share, atol=1e-5)


def test_a_text_usd_may_take_many_times_its_size(tmp_path):
    many = replace(some(), values=np.tile(some().values, (100, 1)))
    assert len(read_splats(written(tmp_path, ".usda", many))) == len(many)


@pytest.mark.parametrize("end", [".glb", ".usdc"])
@pytest.mark.parametrize("up", [None, (0.0, -0.6, 0.8)])
def test_up_that_is_not_known_is_not_told(tmp_path, end, up):
    given = replace(some(1), up=None if up is None else np.array(up))
    found = read_splats(written(tmp_path, end, given))
    assert up is None if found.up is None else found.up == pytest.approx(up, abs=1e-6)


@pytest.mark.parametrize("moved", [False, True])
def test_usd_that_another_program_saved_without_data_of_the_layer(tmp_path, moved):
    file, given = written(tmp_path, ".usdc", some(1)), some(1)
    from pxr import Sdf, Usd, UsdGeom

    layer = Sdf.Layer.OpenAsAnonymous(str(file))
    layer.customLayerData = {}
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, "Z" if moved else "Y")
    if moved:
        UsdGeom.Xform.Define(stage, "/World").AddRotateXOp().Set(90)
    Sdf.CopySpec(layer, "/gvtools", stage.GetRootLayer(), f"{'/World' * moved}/gvtools")
    stage.GetRootLayer().Export(str(tmp_path / "b.usdc"))
    with ZipFile(tmp_path / "b.usdz", "w") as out:
        out.write(tmp_path / "b.usdc", "b.usdc")
    for name in ("b.usdc", "b.usdz"):
        found = read_splats(tmp_path / name)
        check_alike(found, given, (1e-5, 1e-6, 1e-6, 1e-6, 1e-4))
        assert found.up == pytest.approx(given.up, abs=1e-6)


def test_what_a_format_has_no_place_for_is_said(tmp_path, capsys):
    given = replace(some(), mode="mip")
    file = written(tmp_path, ".ply", given)
    rows = PlyData.read(file)["vertex"].data
    above = [(f"f_rest_{number}", "<f4") for number in range(45, 72)]
    wide = np.zeros(COUNT, rows.dtype.descr + above)
    for name in rows.dtype.names:
        wide[name] = rows[name]
    PlyData([PlyElement.describe(wide, "vertex")]).write(tmp_path / "b.ply")
    for end, said in (
        ("a.splat", ", without harmonics, without SplatRenderMode mip"),
        ("a.ksplat", ", harmonics up to degree 2, without SplatRenderMode mip"),
        ("a.spz", "axes right, up, back"),
        ("a.glb", "nothing tells what is up"),
    ):
        told = write_file(replace(given, up=None), tmp_path / end, ExportOptions())
        assert said in told
    assert "Mode" not in write_file(given, tmp_path / "a.sog", ExportOptions())
    run_command("export", tmp_path / "b.ply", "--out", tmp_path / "c.ply")
    assert "harmonics above degree 3 left out" in capsys.readouterr().out
    run_command("export", tmp_path / "a.spz", "--out", tmp_path / "c.ply")
    assert "turned half around x" in capsys.readouterr().out


def test_a_list_of_levels_of_detail_is_no_scene(tmp_path, capsys):
    (tmp_path / "lod-meta.json").write_text('{"version": 1, "lodLevels": 2}')
    said = refused(capsys, "export", tmp_path / "lod-meta.json", "--out", tmp_path / "a.sog")
    assert "expected the meta.json of one piece" in said


def test_harmonics_of_no_whole_degree_are_refused(tmp_path):
    file = written(tmp_path, ".ply", some())
    data = file.read_bytes().replace(b"property float f_rest_44\n", b"property float other\n")
    file.write_bytes(data)
    with pytest.raises(MemoryFileError, match="44 properties f_rest; expected 0, 9, 24 or 45"):
        read_splats(file)


@pytest.mark.parametrize("end", [*ERRORS][:-2])
def test_half_a_file_is_refused(tmp_path, end):
    file = written(tmp_path, end, some(0))
    data = file.read_bytes()
    file.write_bytes(data[: len(data) // 2 - 1])
    with pytest.raises(MemoryFileError, match=f"a{end}: ") as error:
        read_splats(file)
    assert "\n" not in str(error.value)


def test_an_spz_that_its_reader_gives_up_on_without_an_error_is_refused(tmp_path):
    pytest.importorskip("gaussforge")
    file = tmp_path / "a.spz"
    file.write_bytes(b"NGSP" + (4).to_bytes(4, "little") + bytes(4000))
    with pytest.raises(MemoryFileError, match=r"a\.spz: no Gaussians; expected a whole spz"):
        read_splats(file)
