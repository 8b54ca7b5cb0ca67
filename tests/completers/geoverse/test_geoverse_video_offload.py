"""Weights of the video prior that leave the device between passes."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

pytest.importorskip("diffusers", reason="the extra wan is not installed")

import tiny_wan as tiny

from gvtools.completers.geoverse.video_prior import ROOM, _leaves


@pytest.fixture(scope="module")
def network() -> Any:
    return tiny.transformer()


def test_lent_weights_come_home_without_being_copied_back(
    network: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    prior = tiny.prior(network)
    views = (*tiny.views(3), 1)
    wanted = prior.features(*views)
    networks = prior.networks
    tensors = [
        tensor
        for part in (networks.transformer, networks.vae)
        for tensor in (*part.parameters(), *part.buffers())
    ]
    home = [tensor.data_ptr() for tensor in tensors]
    moved: list[torch.device] = []
    to = Tensor.to

    def copied(tensor: Tensor, *args: Any, **kwargs: Any) -> Tensor:
        if args == (torch.device("cpu", 0),):
            # Another place of the same memory stands for a device.
            moved.append(args[0])
            return tensor.clone()
        return to(tensor, *args, **kwargs)

    monkeypatch.setattr(Tensor, "to", copied)
    with networks.lent(torch.device("cpu", 0)):
        away = [tensor.data_ptr() for tensor in tensors]
        assert not {*away} & {*home}
    assert [tensor.data_ptr() for tensor in tensors] == home
    prior._guest = torch.device("cpu", 0)
    moved.clear()
    found = prior.features(*views)
    assert len(moved) >= len(tensors)
    assert [tensor.data_ptr() for tensor in tensors] == home
    for one, other in zip(found.tensors, wanted.tensors, strict=True):
        assert torch.equal(one, other)
    with pytest.raises(ZeroDivisionError), networks.lent(torch.device("cpu", 0)):
        _ = 1 / 0
    assert [tensor.data_ptr() for tensor in tensors] == home


@pytest.mark.parametrize(
    ("device", "offload", "free", "leaves"),
    [
        ("cpu", "always", 0, False),
        ("cuda", "never", 0, False),
        ("cuda", "always", 1e12, True),
        ("cuda", "auto", 1e12, False),
        ("cuda", "auto", ROOM + 999, True),
        ("cuda", "auto", ROOM + 1000, False),
    ],
)
def test_weights_leave_where_a_pass_would_lack_room(
    tmp_path: Any, monkeypatch: pytest.MonkeyPatch, device: str, offload: str, *, free: float,
    leaves: bool,
) -> None:  # fmt: skip
    (tmp_path / "vae").mkdir()
    (tmp_path / "vae" / "x.safetensors").write_bytes(bytes(1000))
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda place: (free, 1e12))
    assert _leaves(tmp_path, device, offload) is leaves
