"""Reports gains and step responses before and after: tables, a picture, a file."""

import math
import pathlib

import yaml

from mjx_nero import files
from mjx_nero.identify.response import SECONDS
from mjx_nero.runs.console import Table
from mjx_nero.tools.tuning.proposal import Tuning, gains

MARK = ": stiffness [N m/rad"  # in the head of the file that ``save_gains`` writes


def table(tuning: Tuning) -> tuple[Table, Table]:
    """Makes tables of the gains and of the step responses, before -> after."""
    columns = ("joint", "inertia [kg m2, kg]", "gravity", "effort", "stiffness", "damping", "sag [mrad, mm]")
    chosen = Table(f"gains of {tuning.robot.name}", columns)
    columns = ("joint", "step [mrad, mm]", "rise [s]", "overshoot [%]", "settled [s]", "error", "saturated [%]")
    seen = Table("step responses at home", columns)
    old, new = gains(tuning.robot), gains(tuning.tuned)
    for load, before, after in zip(tuning.loads, tuning.before, tuning.after, strict=True):
        a, b = old[load.joint], new[load.joint]
        sag_a, sag_b = (1e3 * load.gravity / x["stiffness"] if x["stiffness"] else math.inf for x in (a, b))
        chosen.add(
            load.joint,
            f"{load.light:.3g} .. {load.heavy:.3g}",
            f"{load.gravity:.2f}",
            f"{load.effort:g}",
            _change(a["stiffness"], b["stiffness"], "{:g}"),
            _change(a["damping"], b["damping"], "{:g}"),
            _change(sag_a, sag_b, "{:.1f}"),
        )
        seen.add(
            load.joint,
            f"{1e3 * before.step:.3g}",
            _change(before.rise, after.rise, "{:.2f}"),
            _change(1e2 * before.overshoot, 1e2 * after.overshoot, "{:.1f}"),
            _change(before.settling, after.settling, "{:.2f}"),
            _change(1e3 * before.error, 1e3 * after.error, "{:.1f}"),
            _change(1e2 * before.saturation, 1e2 * after.saturation, "{:.0f}"),
        )
    return chosen, seen


def _change(before: float, after: float, form: str) -> str:
    texts = (form.format(x) if math.isfinite(x) else "never" for x in (before, after))
    return " -> ".join(text.lstrip("-") if not text.strip("-0.") else text for text in texts)  # no "-0.0"


def plot(tuning: Tuning, figure) -> None:
    """Plots the joint positions as a share of the step, before and after, in one panel per joint of a matplotlib figure."""
    n = len(tuning.before)
    columns = min(4, n)
    panels = figure.subplots(math.ceil(n / columns), columns, squeeze=False, sharey=True).ravel()
    for panel, before, after in zip(panels, tuning.before, tuning.after, strict=False):
        settled = [r.settling for r in (before, after) if math.isfinite(r.settling)]
        panel.axhline(1, color="black", linewidth=0.8, linestyle=":", label="target")
        for response, label, color in ((before, "before", "tab:gray"), (after, "after", "tab:blue")):
            panel.plot(response.time, response.position / response.step, label=label, color=color)
        panel.set_title(before.joint, loc="left", fontsize=9)
        panel.set_xlim(0, 1.3 * max(settled, default=SECONDS))
        panel.grid(alpha=0.3)
    for panel in panels[n:]:
        panel.set_axis_off()
    panels[0].legend(fontsize=8, loc="lower right")
    figure.suptitle(f"step responses of {tuning.robot.name}, as a share of the step", x=0.01, ha="left")
    figure.supxlabel("time since the step [s]", fontsize=9)


def save_plot(tuning: Tuning, path: pathlib.Path) -> None:
    """Writes the picture of ``plot``."""
    from matplotlib.figure import Figure

    rows = math.ceil(len(tuning.before) / 4)
    figure = Figure(figsize=(11, 0.8 + 2.1 * rows), layout="constrained")
    plot(tuning, figure)
    with files.whole(path) as part:
        figure.savefig(part, dpi=110)


def save_gains(tuning: Tuning, path: pathlib.Path) -> None:
    """Writes the proposed gains as YAML."""
    units = " or N/m], damping [N m s/rad or N s/m], effort [N m or N], speed [rad/s or m/s]"
    text = f"# Drives of {tuning.robot.name}{MARK}{units}\n{yaml.safe_dump(gains(tuning.tuned), sort_keys=False)}"
    files.write(path, text.encode())
