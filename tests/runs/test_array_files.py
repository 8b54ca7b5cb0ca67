"""Arrays on disk: what numpy reads, the same bytes every time."""

from __future__ import annotations

import numpy as np

from gvtools.runs.arrays import save_arrays


def test_arrays_come_back_with_their_names_types_and_shapes(tmp_path):
    rng = np.random.default_rng(0)
    arrays = {
        "depth": rng.random((30, 40), np.float32),
        "mask": rng.random((30, 40)) > 0.5,
        "said": np.array("words"),
        "turned": rng.random((4, 6)).T,
        "none": np.zeros((0, 3), np.int64),
    }
    save_arrays(tmp_path / "a.npz", **arrays)
    with (tmp_path / "b.npz").open("wb") as file:
        save_arrays(file, **arrays)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    with np.load(tmp_path / "a.npz", allow_pickle=False) as found:
        assert set(found.files) == set(arrays)
        for name, array in arrays.items():
            assert found[name].dtype == array.dtype and np.array_equal(found[name], array)
            assert found[name].shape == array.shape


def test_what_repeats_is_stored_once(tmp_path):
    save_arrays(tmp_path / "a.npz", zeros=np.zeros((500, 500)))
    assert (tmp_path / "a.npz").stat().st_size < 20_000
