"""Networks against the reference values: weights and inputs by formula, outputs by sample.

A fixture is a JSON and an .npz of one name. The rules below are those of its README; whatever a
fixture may choose (cases, shapes, salt, storage) is read from its JSON.
"""

from __future__ import annotations

import json
import math
import zlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from oracle import ORACLE
from torch import Tensor, nn

SMALL = ("cls_token", "camera_token", "pos_embed", "trainable_cls_token")
FORMULA = "formula: "
NETWORK = 3e-5
MATRIX = 1e-5


def _normal(seed: str, shape: Any) -> np.ndarray:
    generator = np.random.default_rng(zlib.crc32(seed.encode("utf-8")))
    return generator.standard_normal(tuple(shape), dtype=np.float32)


def formula_array(key: str, shape: Any, salt: str = "") -> np.ndarray:
    """The float32 weight of state-dict key ``key``."""
    x = _normal(key + salt, shape)
    last = key.rsplit(".", 1)[-1]
    if last == "W":
        return x
    if last in SMALL or key.endswith("bias"):
        return np.float32(0.02) * x
    if x.ndim == 1:
        return np.float32(1) + np.float32(0.1) * x
    return x / np.float32(math.sqrt(math.prod(shape[1:])))


def formula_input(name: str, shape: Any) -> Tensor:
    """The input that a fixture calls "formula: NAME"; the word may be given or left out."""
    return torch.from_numpy(_normal(name.removeprefix(FORMULA), shape))


@torch.no_grad()
def fill_(
    module: nn.Module, salt: str = "", *, skip: tuple[str, ...] = (), prefix: str = ""
) -> None:
    """Every parameter and persistent buffer of ``module``, except the keys named in ``skip``.

    Keys are those of ``module.state_dict()`` with ``prefix`` before them; a name in ``skip`` that
    is no key is an error, so that a renamed parameter is not passed over.
    """
    state = module.state_dict(keep_vars=True)
    absent = set(skip) - {prefix + name for name in state}
    if absent:
        raise KeyError(f"fill_: {sorted(absent)} are no keys of {type(module).__name__}")
    for name, tensor in state.items():
        if prefix + name not in skip:
            tensor.copy_(torch.from_numpy(formula_array(prefix + name, tensor.shape, salt)))


def relative_deviation(found: np.ndarray, expected: np.ndarray) -> float:
    """max|a - b| / max|b|; infinite where ``found`` is not finite."""
    difference = np.abs(np.asarray(found, np.float64) - np.asarray(expected, np.float64))
    largest = float(difference.max(initial=0))
    if not math.isfinite(largest):
        return math.inf
    size = float(np.abs(np.asarray(expected, np.float64)).max(initial=0))
    return largest / size if size else largest


def compare(name: str, tensor: Tensor, stored: Any, spec: dict[str, Any]) -> float:
    """The largest deviation of a tensor from its stored sample and from its statistics.

    Args:
        name: key of the tensor in ``stored``.
        tensor: ours, whole.
        stored: the .npz.
        spec: what the JSON says of it: shape, how it is stored, mean, std, absmax.
    """
    found = tensor.detach().cpu().to(torch.float64).numpy()
    if list(found.shape) != list(spec["shape"]):
        raise AssertionError(f"{name}: shape {found.shape}, expected {tuple(spec['shape'])}")
    expected = stored[name]
    sample = found.reshape(-1)[:: int(spec["stride"])] if spec["stored"] == "stride" else found
    if sample.shape != expected.shape:
        raise AssertionError(f"{name}: sample {sample.shape}, stored {expected.shape}")
    deviations = [relative_deviation(sample, expected)]
    size = spec.get("absmax") or 1.0
    for statistic, value in (
        ("mean", found.mean()),
        ("std", found.std()),
        ("absmax", np.abs(found).max(initial=0)),
    ):
        if statistic in spec:
            gap = abs(float(value) - spec[statistic]) / size
            deviations.append(gap if math.isfinite(gap) else math.inf)
    return max(deviations)


class Fixture:
    """One JSON and its arrays.

    Attributes:
        name: the file's stem.
        data: the JSON.
        arrays: the .npz.
        salt: of the weights.
        cases: what the JSON says of each case.
        deviations: largest deviation of every tensor compared so far.
    """

    def __init__(self, path: str | Path):
        path = Path(path)
        path = path if path.is_absolute() or path.exists() else ORACLE / path
        path = path.with_suffix(".json")
        self.name = path.stem
        self.data: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        self.arrays = np.load(path.with_suffix(".npz"), allow_pickle=False)
        self.salt: str = self.data.get("weights_salt", "")
        self.cases: list[dict[str, Any]] = self.data.get("cases", [])
        self.deviations: dict[str, float] = {}

    def inputs(self, case: int | str) -> dict[str, Tensor]:
        """The stored inputs of a case: its number, or its prefix where that is not "case"."""
        start = f"{_prefix(case)}.in."
        return {
            key.removeprefix(start): torch.from_numpy(np.asarray(self.arrays[key]))
            for key in self.arrays.files
            if key.startswith(start)
        }

    def outputs(self, case: int | str, *, prefix: str = "out.") -> tuple[str, ...]:
        """Names of the case's stored outputs."""
        start = f"{_prefix(case)}.{prefix}"
        return tuple(key.removeprefix(start) for key in self.arrays.files if key.startswith(start))

    def check(
        self,
        case: int | str,
        name: str,
        tensor: Tensor,
        tolerance: float = NETWORK,
        prefix: str = "out.",
    ) -> float:
        """The deviation of an output (``prefix`` "in_check.": of a built input).

        Raises:
            AssertionError: not the stored shape, or a deviation above the tolerance.
        """
        return self.check_key(f"{_prefix(case)}.{prefix}{name}", tensor, tolerance)

    def check_key(self, key: str, tensor: Tensor, tolerance: float = NETWORK) -> float:
        """The deviation of the tensor stored under ``key``."""
        deviation = compare(key, tensor, self.arrays, self.data["tensors"][key])
        self.deviations[key] = max(deviation, self.deviations.get(key, 0.0))
        if not deviation <= tolerance:
            raise AssertionError(
                f"{self.name}: {key} deviates by {deviation:.3g}, more than {tolerance:g}"
            )
        return deviation

    def check_complete(self, case: int | str, *, beside: tuple[str, ...] = ()) -> None:
        """Whether every stored output of a case has been compared.

        Args:
            case: its number, or its prefix.
            beside: names of outputs that another check reads, or that have no counterpart here.

        Raises:
            AssertionError: the case has no output, or one that nothing was compared with.
        """
        stored = self.outputs(case)
        start = f"{_prefix(case)}.out."
        left = [name for name in stored if start + name not in self.deviations]
        unknown = sorted(set(left) - set(beside))
        if not stored or unknown:
            what = f"nothing was compared with {unknown}" if stored else "no output is stored"
            raise AssertionError(f"{self.name}: {_prefix(case)}: {what}")

    def check_prefixes(self, known: Iterable[str]) -> None:
        """Whether every stored output belongs to one of the ``known`` cases.

        Raises:
            AssertionError: outputs of another case.
        """
        prefixes = {key.split(".out.")[0] for key in self.arrays.files if ".out." in key}
        if stray := sorted(prefixes - set(known)):
            raise AssertionError(f"{self.name}: outputs of cases that nothing runs: {stray}")

    def check_weights(self, module: nn.Module, *, prefix: str = "", part: str = "") -> None:
        """Compare the weights of a filled module with the samples that the JSON holds.

        Args:
            module: with the formula's weights.
            prefix: before the module's own keys.
            part: key of ``weights_check`` below which the samples lie, where there are several.
        """
        samples = self.data.get("weights_check", {})
        samples = samples.get(part, {}) if part else samples
        state = {prefix + name: value for name, value in module.state_dict().items()}
        for key, sample in samples.items():
            if key not in state:
                if not prefix or key.startswith(prefix):
                    raise AssertionError(f"{self.name}: the module has no weight {key}")
                continue
            value = state[key].detach().cpu().double()
            if list(value.shape) != list(sample["shape"]):
                raise AssertionError(f"{self.name}: {key} is {tuple(value.shape)}")
            first = value.reshape(-1)[: len(sample["first4"])].numpy()
            gap = max(
                relative_deviation(first, np.asarray(sample["first4"])),
                abs(float(value.norm()) / sample["l2"] - 1),
            )
            if not gap <= 1e-6:
                raise AssertionError(f"{self.name}: weight {key} deviates by {gap:.3g}")


def _prefix(case: int | str) -> str:
    return case if isinstance(case, str) else f"case{case}"
