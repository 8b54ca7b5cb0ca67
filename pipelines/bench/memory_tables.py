"""The predicted memory as tables, and what of it fits a card."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pipelines.bench.memory import WITH

if TYPE_CHECKING:
    from pipelines.console import Console

GB = 1e9


def show_memory(figures: dict[str, Any], console: Console) -> None:
    """Tables of a pass and of a training step in GB (10^9 bytes), and a line about the card."""
    size = "x".join(map(str, figures["size"]))
    console.line(
        f"{figures['config']}, {figures['context']} + {figures['targets']} views of {size}, "
        f"{figures['steps']} + {figures['cascade_steps']} steps, {figures['precision']}: "
        "peak memory of a pass, GB"
    )
    for model in dict.fromkeys(row["model"] for row in figures["inference"]):
        _show_pass(model, [r for r in figures["inference"] if r["model"] == model], console)
    console.line(f"a training step of one sample, {figures['training_precision']}: peak memory, GB")
    console.table(
        ("stage", "video prior", "recompute", "weights", "lasting", *PARTS, "peak"),
        [
            (
                row["stage"],
                "yes" if row["model"] == WITH else "no",
                "yes" if row["recompute"] else "no",
                row["weights_bytes"] / GB,
                row["lasting_bytes"] / GB,
                *(row[f"{part}_bytes"] / GB for part in PARTS),
                row["total_bytes"] / GB,
            )
            for row in figures["training"]
        ],
    )
    if figures["card_gb"] is not None:
        console.line(card_line(figures, figures["card_gb"]))


PARTS = ("forward", "backward", "optimiser")


def _show_pass(model: str, rows: list[dict[str, Any]], console: Console) -> None:
    weights, prior = rows[0]["weights_bytes"] / GB, rows[0]["video_bytes"] / GB
    beside = f" and {prior:.3g} of the prior's" if prior else ""
    console.line(f"{model}: {weights:.3g} of weights{beside}")
    columns = ("prior leaves", "prior stays") if prior else ("all",)
    console.table(
        ("stage", "activations", *columns),
        [
            (
                row["stage"],
                row["activation_bytes"] / GB,
                row["total_bytes"] / GB,
                *((row["total_bytes_video_stays"] / GB,) if prior else ()),
            )
            for row in rows
        ],
    )


def card_line(figures: dict[str, Any], card: float) -> str:
    """What fits a card of so many GB.

    A card of N GB has N GiB: the 7 % above N 10^9 bytes are left to its driver and to what is lost
    between tensors.
    """
    needs: dict[str, float] = {}
    for row in figures["inference"]:
        name = f"a pass {row['model']}"
        needs[name] = max(needs.get(name, 0.0), row["total_bytes"] / GB)
    for row in figures["training"]:
        if row["recompute"]:
            name = f"training {row['stage']} {row['model']} and with recompute"
            needs[name] = row["total_bytes"] / GB
    parts = (
        f"{name} {'fits' if need <= card else 'does not fit'} ({need:.3g})"
        for name, need in needs.items()
    )
    return f"a card of {card:g} GB: {'; '.join(parts)}"
