"""The step before a run in which its kernels are compiled; later runs load what it left."""

from __future__ import annotations

from collections.abc import Sequence
from time import perf_counter
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from gvtools.kernels import KernelSet
    from pipelines.console import Console
    from pipelines.reconstruction.settings import RunSettings


def compile_kernels(
    config: RunSettings, console: Console, *, more: Sequence[KernelSet] = ()
) -> None:
    """Compile what numba's cache does not hold, side by side, so that no round is charged with it.

    Args:
        config: of the run; its completer and the back end of projection tell which kernels.
        console: is told what is compiled and how long it took.
        more: kernels that are needed besides.
    """
    from gvtools.completers.base import completer_type
    from gvtools.depth import view_check
    from gvtools.kernels import compile_side_by_side
    from gvtools.memory import compile_kernels as memory

    completer = completer_type(config.completer)
    sets = [memory.KERNELS, view_check.KERNELS, *completer.kernels, *more]
    if completer.costly and config.effort.inpaint_below > 0:
        sets += completer_type("inpaint").kernels
    if config.refine.wanted:
        from gvtools.appearance.compile_kernels import kernel_sets

        sets += kernel_sets()
    missing = [kernels for kernels in sets if not kernels.cached]
    began = perf_counter()
    if missing:
        names = ", ".join(kernels.name for kernels in missing)
        console.line(f"compiling kernels ({names}), once per installation")
        compile_side_by_side(missing)
    memory.compile_kernels(config.splat.backend)
    if missing:
        console.line(f"kernels compiled in {perf_counter() - began:.0f} s")
