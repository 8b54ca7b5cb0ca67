from __future__ import annotations

import numpy as np
import pytest
import torch
from memory_scenes import random_camera, random_memory
from reference_splat import IMAGES, OTHERS, assert_same, reference_project

from gvtools.cameras import concatenate
from gvtools.errors import OptionError
from gvtools.memory.projection import project
from gvtools.memory.splat import torch_splatter as splat_torch
from gvtools.memory.splat.api import SplatOptions
from gvtools.memory.splat.torch_splatter import torch_device

DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)]


def project_torch(memory, cameras, *, options=None, device="auto"):
    options = (options or SplatOptions()).replaced(backend="torch", device=device)
    return project(memory, cameras, options=options)


def _target(seed: int):
    return random_camera(np.random.default_rng(100 + seed), spread=0.5)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("options", OTHERS)
@pytest.mark.parametrize("seed", range(4))
def test_random_memories_look_as_the_reference_says(seed, options, device):
    memory = random_memory(seed)
    ours = project_torch(memory, _target(seed), options=options, device=device)
    assert_same(ours, reference_project(memory, _target(seed), options))


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("seed", range(4, 8))
def test_a_larger_image_equals_the_compiled_back_end(seed, device):
    memory = random_memory(seed, most=300)
    cameras = concatenate([_target(seed).resized(160, 120), _target(seed + 1).resized(160, 120)])
    ours = project_torch(memory, cameras, device=device)
    assert ours.coverage > 0.1
    assert_same(ours, project(memory, cameras))


@pytest.mark.parametrize("device", DEVICES)
def test_the_same_projection_twice_gives_the_same_bytes(device):
    memory = random_memory(5, most=300)
    target = _target(5).resized(160, 120)
    one, two = (project_torch(memory, target, device=device) for _ in range(2))
    for name in IMAGES:
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))


def test_cutting_the_work_into_parts_changes_nothing_but_rounding(monkeypatch):
    memory = random_memory(6)
    whole = project_torch(memory, _target(6), device="cpu")
    monkeypatch.setitem(splat_torch.PAIRS, "cpu", 100)
    parts = project_torch(memory, _target(6), device="cpu")
    assert whole.coverage > 0.3
    for name in IMAGES:
        np.testing.assert_allclose(
            getattr(parts, name).astype(float), getattr(whole, name).astype(float), atol=1e-5
        )


def test_cuda_is_refused_where_there_is_none(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(OptionError, match="no CUDA device"):
        project_torch(random_memory(1), _target(1), device="cuda")
    assert torch_device("auto").type == "cpu"
    assert torch_device("cpu").type == "cpu"
