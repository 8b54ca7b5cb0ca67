# mypy: no-check-untyped-defs
from __future__ import annotations

import numpy as np
import pytest
from quake_map import FLOOR, HALF, LIGHT, MATERIALS, SKIES, WALL, room, write_archive

from benchmarks.experiments.level_cases import level_cases
from benchmarks.experiments.level_render import STORED_LIGHT, LevelScene
from benchmarks.experiments.level_textures import Pictures, shown_pictures
from benchmarks.experiments.level_walks import unjudged, write_walks
from benchmarks.experiments.quake_levels import Archives, read_level
from gvtools.cameras import Cameras, rigid_poses
from gvtools.errors import ProjectError
from gvtools.scenes.project import open_project
from gvtools.training.samples import Observation, project_observation


@pytest.fixture(scope="module")
def archives(tmp_path_factory) -> Archives:
    return Archives(write_archive(tmp_path_factory.mktemp("level"), {"room": room()}))


@pytest.fixture(scope="module")
def scene(archives) -> LevelScene:
    level = read_level(room())
    return LevelScene(level, Pictures(archives).of(level.materials))


def looking(direction: tuple[float, float, float], place: tuple[float, float, float]) -> Cameras:
    z = np.array(direction, float)
    x = np.array([1.0, 0, 0]) if abs(z[2]) > 0.5 else np.cross(z, [0, 0, 1])
    axes = np.stack([x, np.cross(z, x), z])
    pose = rigid_poses(axes, -axes @ place)
    return Cameras.pinhole(48, 48, focal=24.0, cam_from_world=pose)


def test_what_is_drawn_is_read_and_the_rest_left_out():
    level = read_level(room())
    assert level.materials == tuple(name for name, _, _ in MATERIALS)
    # Six sides of two triangles, and 4 x 4 quads of the patch; no glass, no clip.
    assert set(level.material) == {WALL, FLOOR} and len(level.triangles) == 6 * 2 + 4 * 4 * 2
    assert (level.lightmap[level.material == FLOOR] == 0).all()
    assert (level.lightmap[level.material == WALL] == -1).all()
    np.testing.assert_array_equal(level.starts, [(-100, 0, 24)])
    np.testing.assert_array_equal(read_level(room(ceiling=SKIES)).sky, np.arange(5) == SKIES)


def test_patches_follow_the_bezier_curve():
    level = read_level(room())
    patch = level.positions[np.unique(level.triangles[12:])].astype(float)
    t = (patch[:, 1] + 240) / 80
    np.testing.assert_allclose(patch[:, 2], 2 * t * (1 - t) * 64, atol=1e-4)
    assert patch[:, 2].max() == pytest.approx(32)
    # Its triangles cover it once.
    corners = level.positions[level.triangles[12:]].astype(float)[..., :2]
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]) / 2
    assert area.sum() == pytest.approx(40 * 80)


def test_depth_is_exact_and_light_is_baked_times_picture(scene):
    light, depth = scene.render(looking((0, 0, -1), (100, 100, 80)))
    np.testing.assert_allclose(depth, 80, rtol=1e-5)
    expected = STORED_LIGHT * np.array(LIGHT) / 255 * 200 / 255
    np.testing.assert_allclose(light[0], np.broadcast_to(expected, light[0].shape), rtol=1e-4)


def test_a_wall_shows_the_picture_that_its_script_names(scene):
    place = (100.0, 3.0, 127.0)
    camera = looking((1, 0, 0), place)
    light, depth = scene.render(camera)
    wall = np.s_[0, 8:40, 8:40]
    np.testing.assert_allclose(depth[wall], HALF - 100, rtol=1e-5)
    # Where the rays of each pixel meet the wall, and the check that is there.
    fine = camera.resized(144, 144)
    points = fine.rays() @ fine.cam_from_world[0, :3, :3] * (HALF - 100) + place
    check = np.floor(points[..., 1:] / 128 * 4).astype(int).sum(-1) % 2
    expected = STORED_LIGHT * 128 / 255 * np.where(check, 0.5, 1)
    expected = expected.reshape(48, 3, 48, 3).mean((1, 3))[..., None] * (240, 120, 60) / 255
    np.testing.assert_allclose(light[wall], expected[wall[1:]], atol=1e-3)


def test_scripts_name_pictures():
    script = "a/b\n{\n{ map $lightmap }\n{\nclampmap X/y.tga // z\n} }\nc\n{\nskyparms env/q - -\n}"
    assert shown_pictures(script) == {"a/b": "x/y.tga"}


def test_cases_of_levels_have_holes_and_truth(tmp_path):
    folder = write_archive(tmp_path, {"one": room(), "two": room(), "open": room(ceiling=SKIES)})
    cases = list(level_cases(folder, 9, seed=3, size=64))
    names = [case.name for case in cases]
    assert "one" in names and len(set(names)) == len(names) <= 3
    again = next(iter(level_cases(folder, 9, seed=3, size=64)))
    assert cases[0].guidance.rgb.tobytes() == again.guidance.rgb.tobytes()
    for case in cases:
        known = ~case.generated
        assert known.any() and len(case.context) + len(case.rgb) == 8
        assert np.median(np.abs(case.guidance.depth / case.depth - 1)[known]) < 0.05


def test_wrong_files_are_one_line(tmp_path):
    with pytest.raises(ProjectError, match=r"no \.pk3 archive with a \.bsp map"):
        Archives(tmp_path)
    (tmp_path / "broken.pk3").write_bytes(b"PK nothing")
    with pytest.raises(ProjectError, match="not a pk3 archive"):
        Archives(tmp_path)
    with pytest.raises(ProjectError, match="expected IBSP, version 46"):
        read_level(b"IBSP" + (47).to_bytes(4, "little") + bytes(200), "q.bsp")
    with pytest.raises(ProjectError, match="ends at byte"):
        read_level(room()[:-9], "q.bsp")


def test_versions_of_judged_maps_are_left_out():
    maps = ("maps/castle2.bsp", "maps/cavern.bsp", "maps/q1.bsp", "maps/q12.bsp")
    assert unjudged(maps, ("maps/castle.bsp", "maps/q1.bsp")) == ["maps/cavern.bsp", "maps/q12.bsp"]


def test_walks_are_scenes_whose_views_agree(tmp_path):
    levels = write_archive(tmp_path / "levels", {"cellar": room(), "attic": room()})
    judged = write_archive(tmp_path / "judged", {"attic2": room(), "attic": room()})
    out, said = tmp_path / "out", []
    options = {"walks": 2, "views": 3, "size": 48, "say": said.append}
    folders = write_walks(levels, judged, out, **options)
    assert [folder.name for folder in folders] == ["cellar_0", "cellar_1"]
    assert said == ["cellar: 2 walks"]
    pictures = [(folder / "frame-000000.color.png").read_bytes() for folder in folders]
    assert pictures[0] != pictures[1]
    scene = open_project(folders[0])
    first, last = (scene[name] for name in scene.names[::2])
    frames = [view.load() for view in (first, last)]
    assert len(scene) == 3 and min(frame.depth.min() for frame in frames) > 0
    from gvtools.completers.base import ContextView

    given = ContextView(first.name, first.camera, frames[0].rgb, frames[0].depth)
    guidance = project_observation(Observation((given,), (first.camera,)), last.camera)
    known = guidance.valid[0]
    assert known.mean() > 0.3
    error = np.abs(guidance.depth[0] / frames[1].depth - 1)[known]
    assert np.median(error) < 0.01
    # What is there is kept.
    (folders[0] / "frame-000000.color.png").write_bytes(b"mine")
    write_walks(levels, judged, out, **options)
    assert (folders[0] / "frame-000000.color.png").read_bytes() == b"mine"
