"""Where a run writes: config, metrics, TensorBoard, learning curve."""

import contextlib
import importlib.metadata as metadata
import json
import os
import pathlib
import sys
from collections.abc import Iterator
from typing import Any

import jax

from mjx_nero.types import UserError


class RunFolder:
    """Where a run writes. Refuses a folder that holds another run, unless that run goes on.

    Raises:
        UserError: the folder holds a run, or cannot be written.
    """

    def __init__(self, path: pathlib.Path, resume: bool):
        self.path = path
        self.rows: list[dict[str, float]] = []
        self._tensorboard: Any = None
        if (path / "config.json").exists() and not resume:
            raise UserError(f"{path} already holds a run: pass another --out, or --restore {path} to go on with it")
        try:
            path.mkdir(parents=True, exist_ok=True)
            probe = path / ".probe"
            probe.touch()
            probe.unlink()
        except OSError as error:
            raise UserError(f"cannot write to {path}: {error.strerror or error}; pass another --out") from None
        self._metrics = path / "metrics.jsonl"

    @contextlib.contextmanager
    def unless_failed(self):
        """Leaves no empty folder behind if what comes before ``begin`` fails or is interrupted."""
        try:
            yield
        except BaseException:
            with contextlib.suppress(OSError):  # it holds a run
                self.path.rmdir()
            raise

    def begin(self, run: dict[str, Any], start: int) -> None:
        """Writes the resolved config; keeps the metrics of a resumed run up to env step ``start``."""
        from tensorboardX import SummaryWriter

        resolved = {**run, "versions": versions()}
        (self.path / "config.json").write_text(json.dumps(resolved, indent=2, default=str) + "\n")
        if self._metrics.exists():
            for line in self._metrics.read_text().splitlines():
                with contextlib.suppress(ValueError):  # a line that a killed run left half-written
                    row = json.loads(line)
                    self.rows += [row] if row["steps"] <= start else []
        self._metrics.write_text("".join(json.dumps(row) + "\n" for row in self.rows))
        self._tensorboard = SummaryWriter(str(self.path / "tensorboard"), purge_step=start or None)

    def log(self, row: dict[str, float]) -> None:
        """Appends one row of metrics."""
        self.rows.append(row)
        with self._metrics.open("a") as file:
            file.write(json.dumps(row) + "\n")
        for name, value in row.items():
            self._tensorboard.add_scalar(name, value, int(row["steps"]))

    def close(self) -> None:
        """Flushes the logs and draws the learning curve."""
        if self._tensorboard is not None:
            self._tensorboard.close()
        if self.rows:
            plot_curve(self.rows, self.path / "curve.png")


def check_writable(path: pathlib.Path) -> None:
    """Before long work: a file that is to be written at its end.

    Raises:
        UserError: it is a folder, or its folder does not exist or is not writable.
    """
    if path.is_dir():
        raise UserError(f"{path} is a folder: give a file name")
    if not path.parent.is_dir() or not os.access(path.parent, os.W_OK):
        raise UserError(f"cannot write {path}: the folder {path.parent} does not exist or is not writable")


@contextlib.contextmanager
def whole(path: pathlib.Path) -> Iterator[pathlib.Path]:
    """Where to write a file that then appears whole or not at all.

    Raises:
        UserError: it cannot be written.
    """
    part = path.with_name(f".{path.stem}.part{path.suffix}")
    try:
        yield part
        part.replace(path)
    except (OSError, ValueError) as error:  # ValueError: a kind of file that a library does not know
        raise UserError(f"cannot write {path}: {getattr(error, 'strerror', None) or error}") from None
    finally:
        part.unlink(missing_ok=True)


def versions() -> dict[str, str]:
    """Versions of what decides a result, and the device."""
    names = ("mjx-nero", "mujoco", "mujoco-mjx", "jax", "brax", "flax", "optax", "warp-lang")
    found = {}
    for name in names:
        with contextlib.suppress(metadata.PackageNotFoundError):
            found[name] = metadata.version(name)
    return {**found, "python": sys.version.split()[0], "device": jax.devices()[0].device_kind}


def plot_curve(rows: list[dict[str, float]], path: pathlib.Path) -> None:
    """Success, return and every reward term over env steps."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 3.8), layout="constrained")
    success, returns, terms = figure.subplots(1, 3)

    def line(axes, name, **style):
        points = [(row["steps"] / 1e6, row[name]) for row in rows if name in row]
        if points:
            axes.plot(*zip(*points, strict=True), **style)

    line(success, "train/success", label="training (with exploration noise)", color="tab:gray")
    line(success, "eval/success_rate", label="evaluation", color="tab:blue", marker="o", markersize=3)
    line(returns, "train/return", label="training", color="tab:gray")
    line(returns, "eval/return_mean", label="evaluation", color="tab:blue", marker="o", markersize=3)
    for name in sorted({k for row in rows for k in row if k.startswith("reward/")}):
        line(terms, name, label=name.removeprefix("reward/"))
    for axes, title in ((success, "success rate"), (returns, "return of an episode"), (terms, "return by term (training)")):
        axes.set_title(title)
        axes.set_xlabel("env steps [million]")
        axes.grid(alpha=0.3)
        if axes.get_legend_handles_labels()[0]:
            axes.legend(fontsize=7)
    success.set_ylim(-0.02, 1.02)
    figure.savefig(path, dpi=110)
