from __future__ import annotations

import io

import numpy as np
import pytest
from export_runs import export_run
from PIL import Image

from gvtools.memory.thinning import thin

pytest.importorskip("rerun")


def chunks(path):
    """Entity, and its columns by name, of every chunk that is not static."""
    from rerun.chunk import RrdReader

    for chunk in RrdReader(path).store().stream():
        if not chunk.is_static:
            batch = chunk.to_record_batch()
            names = [name for name in batch.schema.names if name != "log_time"]
            yield str(chunk.entity_path), batch.select(names).to_pydict()


def test_points_come_with_their_rounds(reconstructed_run, tmp_path):
    export_run(reconstructed_run.path, "rrd", tmp_path / "out.rrd")
    memory = reconstructed_run.memory
    rows = thin(memory, None).rows
    rounds, made = memory.columns.round[rows], memory.generated[rows]
    found = {
        entity: (columns["round"][0], np.array(columns["Points3D:positions"][0]))
        for entity, columns in chunks(tmp_path / "out.rrd")
        if "Points3D:positions" in columns
    }
    expected = {}
    for number in memory.rounds:
        for kind, chosen in (("observed", ~made), ("generated", made)):
            of_both = rows[chosen & (rounds == number)]
            if len(of_both):
                expected[f"/memory/{kind}/round_{number:03d}"] = memory.positions[of_both]
    assert set(found) == set(expected) and len(found) > 1
    for entity, positions in expected.items():
        number, read = found[entity]
        assert number == int(entity[-3:])
        np.testing.assert_allclose(read, positions, atol=1e-5)


def test_cameras_stand_where_they_stood_with_their_pictures(reconstructed_run, tmp_path):
    export_run(reconstructed_run.path, "rrd", tmp_path / "out.rrd")
    found = {
        entity.split("/")[-1].replace("\\", ""): (entity, columns)
        for entity, columns in chunks(tmp_path / "out.rrd")
        if "Pinhole:image_from_camera" in columns
    }
    pictures = {
        entity: columns["EncodedImage:blob"][0][0]
        for entity, columns in chunks(tmp_path / "out.rrd")
        if "EncodedImage:blob" in columns
    }
    scene, truths = reconstructed_run.scenes
    targets = [view.name for view in reconstructed_run.views]
    assert sorted(found) == sorted([*reconstructed_run.context, *targets]) and targets
    for name, (entity, columns) in found.items():
        view = (truths if name in targets else scene)[name]
        kind = "generated" if name in targets else "context"
        assert entity.startswith(f"/cameras/{kind}/round_00")
        center = np.array(columns["Transform3D:translation"][0][0])
        np.testing.assert_allclose(center, view.camera.centers[0], atol=1e-6)
        turn = np.array(columns["Transform3D:mat3x3"][0][0]).reshape(3, 3).T
        np.testing.assert_allclose(turn, view.camera.world_from_cam[0, :3, :3], atol=1e-6)
        picture = np.asarray(Image.open(io.BytesIO(bytes(pictures[entity]))), float)
        wanted = view.load().rgb
        assert picture.shape == wanted.shape
        assert np.abs(picture - wanted).mean() < 12


def test_an_earlier_round_has_no_later_cameras(reconstructed_run, tmp_path):
    export_run(reconstructed_run.path, "rrd", tmp_path / "out.rrd", "--round", 0)
    entities = [entity for entity, _ in chunks(tmp_path / "out.rrd")]
    assert entities and not any("generated" in entity for entity in entities)
