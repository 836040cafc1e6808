"""Reports identified drives: a table, a picture, a file."""

import math
import pathlib
from collections.abc import Sequence

import numpy as np
import yaml

from mjx_nero import files
from mjx_nero.identify.fit import Fit
from mjx_nero.identify.log import Log
from mjx_nero.identify.plant import POSITIVE, Drives
from mjx_nero.runs.console import Table

SIMULATED, MOVEMENT = "simulated; its parameters:", "identification's movement"  # notes in the heads of logs
MARK = ", identified from "  # in the head of the file that ``save`` writes
_HEAD = f"""\
# Drives of {{robot}}{MARK}{{log}}: values with 95% intervals if the arm follows the equation of identify.
# For make(identified=FILE) and --env.identified FILE.
# stiffness [N m/rad or N/m], damping [N m s/rad or N s/m], armature [kg m2 or kg], friction [N m or N], delay [s];
# offset [rad or m]: encoder reading minus joint position, to be subtracted on the real arm.
"""


def table(joints: Sequence[str], fit: Fit, nominal: Drives) -> Table:
    """Makes the table of identified drives, one row per joint."""
    view = Table(
        "identified, +- if the arm follows the equation (the model's own)",
        ("joint", *POSITIVE, "offset [mrad, mm]", "error held out [mrad, mm]"),
    )
    for i, joint in enumerate(joints):
        cells = []
        for name in POSITIVE:
            value, low, high, own = (float(getattr(x, name)[i]) for x in (fit.drives, fit.low, fit.high, nominal))
            cells.append(f"{value:.4g} +-{_digit((high - low) / 2)} ({own:.3g})")
        offset, width = fit.drives.offset[i], (fit.high.offset - fit.low.offset)[i] / 2
        cells += [f"{1e3 * offset:.2f} +-{_digit(1e3 * width)}", f"{1e3 * fit.rms[i]:.3f} ({1e3 * fit.nominal_rms[i]:.3g})"]
        view.add(joint, *cells)
    half = (fit.high.delay - fit.low.delay) / 2
    view.caption = f"delay {1e3 * fit.drives.delay:.2f} +-{_digit(1e3 * half)} ms"
    return view


def save(path: pathlib.Path, robot: str, log: str, joints: Sequence[str], fit: Fit) -> None:
    """Writes the YAML that ``envs.identified`` reads."""

    def number(name: str, i: int | None = None) -> dict[str, float]:
        low, value, high = (
            float(getattr(x, name) if i is None else getattr(x, name)[i]) for x in (fit.low, fit.drives, fit.high)
        )
        low, value, high = (float(f"{x:.6g}") for x in (low, value, high))
        return {"value": value, "low": min(low, value), "high": max(high, value)}

    rows = {j: {name: number(name, i) for name in (*POSITIVE, "offset")} for i, j in enumerate(joints)}
    content = {"robot": robot, "delay": number("delay"), "joints": rows}
    head = _HEAD.format(robot=robot, log=" ".join(log.split()))
    files.write(path, (head + yaml.safe_dump(content, sort_keys=False, default_flow_style=None)).encode())


def plot(joints: Sequence[str], log: Log, fit: Fit, figure) -> None:
    """Plots simulated minus measured positions over time, one panel per joint, for the identified and the model's drives."""
    columns = min(3, len(joints))
    panels = figure.subplots(math.ceil(len(joints) / columns), columns, squeeze=False, sharex=True).ravel()
    thin = slice(None, None, max(1, len(log.times) // 4000))
    # Linear up to a power of ten, where the first tick beside zero is: a smaller one would be written over zero's.
    linear = 10.0 ** math.ceil(math.log10(max(1e-3, 3e3 * float(np.min(fit.rms)))))
    for i, (panel, joint) in enumerate(zip(panels, joints, strict=False)):
        for path, label, color in (
            (fit.nominal, "the model's own drives", "tab:gray"),
            (fit.readings, "identified", "tab:blue"),
        ):
            panel.plot(log.times[thin], 1e3 * (path - log.positions)[thin, i], label=label, color=color, linewidth=0.7)
        panel.axvspan(log.times[fit.held][0], log.times[-1], color="tab:orange", alpha=0.12, label="held out")
        panel.set_title(f"{joint}: held out {1e3 * fit.rms[i]:.3g} (was {1e3 * fit.nominal_rms[i]:.3g})", loc="left", fontsize=9)
        panel.set_yscale("symlog", linthresh=linear)
        panel.tick_params(labelsize=7, labelbottom=i >= len(joints) - columns)
        panel.grid(alpha=0.3)
    for panel in panels[len(joints) :]:
        panel.set_axis_off()
    panels[0].legend(fontsize=7, loc="lower left")
    figure.suptitle("simulated minus measured position [mrad, mm]", x=0.01, ha="left")
    figure.supxlabel("time [s]", fontsize=9)


def save_plot(path: pathlib.Path, joints: Sequence[str], log: Log, fit: Fit) -> None:
    """Writes the picture of ``plot``."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 0.8 + 2.2 * math.ceil(len(joints) / 3)), layout="constrained")
    plot(joints, log, fit, figure)
    with files.whole(path) as part:
        figure.savefig(part, dpi=110)


def _digit(value: float) -> str:
    """Formats a number with one significant digit, without an exponent if it is large."""
    return f"{float(f'{value:.1g}'):g}"
