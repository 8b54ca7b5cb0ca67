"""The cells of a benchmark measured one after another, each in a process of its own.

A process of its own tells a cell's peak memory, and one that the system ends for want of memory
leaves the others to go on. It ends with the command that began it, however that ends.
"""

from __future__ import annotations

import hashlib
import json
import os
import traceback
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import gvtools
from gvtools.errors import GvError, OptionError
from gvtools.files import write_json
from gvtools.untrusted import read_json
from pipelines.benchmark.measure import Cell, measure_cell
from pipelines.console import Console

MEASURED, FAILED = "measured", "failed"
Measure = Callable[[Cell], None]


def identity(cell: Cell) -> dict[str, Any]:
    """What decides a cell's figures, JSON-ready; kept in its file and compared on going on."""
    from gvtools.evaluation.published import load_benchmark

    spec = load_benchmark(cell.benchmark).model_dump_json(include={"splits", "resolution"})
    lpips = None if cell.lpips is None else cell.lpips[0]
    return {
        "benchmark": cell.benchmark,
        "protocol": hashlib.sha256(spec.encode()).hexdigest()[:16],
        "root": str(cell.root),
        "settings": json.loads(json.dumps(dict(cell.method.settings), default=str)),
        "pictures": None if cell.method.pictures is None else str(cell.method.pictures),
        "seconds": cell.seconds,
        "lpips": lpips,
        "version": gvtools.__version__,
    }


def read_cell(cell: Cell) -> dict[str, Any] | None:
    """What a cell's file holds; None where there is none, or a damaged one."""
    try:
        found = read_json(cell.result)
        before = found["identity"]
    except (OSError, ValueError, KeyError, TypeError):
        return None
    now = identity(cell)
    for key, value in now.items():
        if before.get(key) != value:
            raise OptionError(
                f"{cell.result}: measured with {key} {before.get(key)!r}, now {value!r}; give the "
                "same, or another --out"
            )
    return dict(found)


def measure_cells(
    cells: Sequence[Cell],
    *,
    console: Console,
    measure: Measure,
    after: Callable[[], None],
) -> None:
    """Measure those that are not measured yet; what fails is kept with its reason, and tried again.

    Pictures of other methods are always measured: they may have changed, and it takes no time.

    Args:
        cells: in the order in which they are measured.
        console: is told of each.
        measure: measures one and writes its file.
        after: called after each.
    """
    before = [read_cell(cell) for cell in cells]
    for number, (cell, found) in enumerate(zip(cells, before, strict=True), start=1):
        where = f"[{number}/{len(cells)}] {cell.scene}, {cell.views} views, {cell.method.name}"
        if found and found["status"] == MEASURED and cell.method.pictures is None:
            console.line(f"{where}: measured before, {described(found)}")
            continue
        console.line(where)
        measure(cell)
        result = read_cell(cell) or {"status": FAILED, "reason": "left no result"}
        if result["status"] == FAILED:
            console.warn(f"{where}: failed: {result['reason']}")
        else:
            console.line(f"{where}: {described(result)}")
        after()


def described(result: Mapping[str, Any]) -> str:
    """A cell's accuracy and cost, in words."""
    psnr, seconds, peak = result["figures"]["psnr"], result.get("seconds"), result.get("peak_bytes")
    words = ["no PSNR" if psnr is None else f"{psnr:.2f} dB"]
    words += [] if seconds is None else [f"{seconds:.1f} s"]
    words += [] if peak is None else [f"{peak / 2**20:.0f} MiB"]
    return ", ".join(words)


def measure_and_write(cell: Cell) -> None:
    """Measure a cell in this process and write its file, with the reason where that fails."""
    head = {"identity": identity(cell), "scene": cell.scene, "views_given": cell.views,
            "method": cell.method.name}  # fmt: skip
    try:
        write_json(cell.result, {**head, "status": MEASURED, **measure_cell(cell)})
    except GvError as error:
        write_json(cell.result, {**head, "status": FAILED, "reason": str(error)})
    except Exception as error:
        reason = f"unexpected {type(error).__name__}: {error}"
        trace = traceback.format_exc()
        write_json(cell.result, {**head, "status": FAILED, "reason": reason, "trace": trace})


def measure_apart(cell: Cell) -> None:
    """Measure a cell in a process of its own."""
    import multiprocessing

    # Of a kill, nothing is left but what stood there before.
    cell.result.unlink(missing_ok=True)
    process = multiprocessing.get_context("spawn").Process(target=_child, args=(cell,))
    process.start()
    try:
        process.join()
    except BaseException:
        process.kill()
        raise
    if not cell.result.is_file():
        head = {"identity": identity(cell), "scene": cell.scene, "views_given": cell.views,
                "method": cell.method.name}  # fmt: skip
        write_json(cell.result, {**head, "status": FAILED, "reason": _ended(process.exitcode)})


def _ended(code: int | None) -> str:
    if code == -9:
        return "its process was killed; the system does that when memory runs out"
    return f"its process ended with exit status {code}"


def _child(cell: Cell) -> None:
    import signal
    import threading

    # A terminal interrupts this process, too; the command's own ends it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    measure_and_write(cell)


def _end_with_parent() -> None:
    """End this process when the command that began it is gone, even when that was killed."""
    import multiprocessing
    from multiprocessing.connection import wait

    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)
