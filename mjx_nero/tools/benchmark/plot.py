"""Plots rates and memory over the number of environments."""

import pathlib
from typing import Any

from mjx_nero.tools.benchmark.machine import Row

PLOTTED = ("physics", "step", "ppo", "control", "reset")
_MEMORY: tuple[tuple[str, Any], ...] = (("memory_mb", "-"), ("warp_mb", ":"))  # key of a row, style of its line


def plot(rows: list[Row], title: str, path: pathlib.Path) -> None:
    """Plots median rates on the left, with bars from the slowest to the fastest repeat, and memory on the right; both log-log."""
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    figure = Figure(figsize=(12, 5), layout="constrained")
    speed, memory = figure.subplots(1, 2)
    lines: dict[tuple[str, str], list[Row]] = {}
    for row in sorted((row for row in rows if _rate(row)), key=lambda row: row["num_envs"]):
        lines.setdefault((row["what"], row["impl"]), []).append(row)
    for i, ((what, impl), points) in enumerate(lines.items()):
        sizes, color = [p["num_envs"] for p in points], f"C{i % 10}"
        low, middle, high = zip(*(_rate(p) for p in points), strict=True)
        bars = [[m - x for m, x in zip(middle, low, strict=True)], [x - m for m, x in zip(middle, high, strict=True)]]
        label = f"{what}, {impl}" + (" (resets/s)" if what == "reset" else "")
        speed.errorbar(sizes, middle, yerr=bars, label=label, color=color, marker="o", markersize=4, capsize=3)
        for key, style in _MEMORY:
            known = [(p["num_envs"], p[key]) for p in points if p.get(key)]
            if known:
                memory.plot(*zip(*known, strict=True), style, label=f"{what}, {impl}", color=color, marker="o", markersize=4)
    for axes, unit in ((speed, "env steps/s"), (memory, "MB")):
        axes.set_xscale("log", base=2)
        axes.set_yscale("log")
        every = sorted({row["num_envs"] for points in lines.values() for row in points})
        axes.set_xticks(every, [f"{n:,}" for n in every])
        axes.tick_params(axis="x", labelrotation=30)
        axes.xaxis.minorticks_off()
        axes.set_xlabel("environments")
        axes.set_ylabel(unit)
        axes.grid(alpha=0.3)
    speed.set_title("throughput, median and range")
    memory.set_title("memory of the program")
    speed.legend(fontsize=8)
    if any(row.get("warp_mb") for row in rows):
        styles = [Line2D([], [], color="gray", linestyle=style) for _, style in _MEMORY]
        memory.legend(styles, ["XLA's program", "Warp's buffers"], fontsize=8)
    figure.suptitle(title)
    figure.savefig(path, dpi=110)


def _rate(row: Row) -> tuple[float, float, float] | None:
    """Returns the lowest, median and highest rate; None if the row has none (another kind of row, or an error)."""
    for name in ("env_steps_per_s", "resets_per_s"):
        if name in row:
            return row[f"{name}_min"], row[name], row[f"{name}_max"]
    return None
