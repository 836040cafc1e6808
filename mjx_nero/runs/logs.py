"""The logs of a run. They are expendable: if one cannot be written, training continues without it."""

import contextlib
import functools
import json
import pathlib
import time
from collections.abc import Callable, Iterator
from typing import Any, Protocol

from mjx_nero import files
from mjx_nero.errors import UserError
from mjx_nero.files import imports

METRICS = "metrics.jsonl"
MAX_METRICS = 200_000_000  # bytes
Row = dict[str, Any]


class Tracker(Protocol):
    """A service that also receives metrics. Its errors lose data, but never stop the run."""

    def write(self, row: Row) -> None:
        """Takes a row of metrics."""

    def close(self) -> None:
        """Ends the log after the last row."""


class Logs:
    """Writes ``metrics.jsonl`` and TensorBoard's files, and feeds a tracker.

    Everything runs in the caller's thread. TensorBoard's usual writer has a thread that dies when the disk is full, and then
    blocks its callers forever.

    Args:
        warn: called with a line when something is lost for the first time.
        active: False in processes that are not the first, which write nothing.
        tracker: makes the tracker, at the first row.
    """

    def __init__(
        self,
        folder: pathlib.Path,
        warn: Callable[[str], None],
        active: bool = True,
        tracker: Callable[[], Tracker] | None = None,
    ):
        self.lost: dict[str, int] = {}  # lost rows or pictures, by file
        self._folder, self._warn, self._active = folder, warn, active
        self._events: Any = None
        self._make_tracker = tracker
        self._tracker: Tracker | None = None

    def write(self, row: Row) -> None:
        """Writes a row of metrics, placed by its ``steps``."""
        if not self._active:
            return
        row = files.finite(row)
        with self._expendable(METRICS):
            _append(self._folder / METRICS, json.dumps(row, allow_nan=False))
        with self._expendable("tensorboard"):
            self._write_events(row)
        if self._make_tracker is not None:
            make, self._make_tracker = self._make_tracker, None  # tried once, because it may wait for a network
            with self._expendable("track", (Exception,)):
                self._tracker = make()
        if self._tracker is not None:
            with self._expendable("track", (Exception,)):
                self._tracker.write(row)

    def close(self) -> None:
        """Closes the logs, and draws the learning curve of all rows."""
        if not self._active:
            return
        with self._expendable("tensorboard"):
            if self._events is not None:
                self._events.close()
        if self._tracker is not None:
            with self._expendable("track", (Exception,)):
                self._tracker.close()
        with self._expendable("curve.png"):
            rows = read(self._folder / METRICS)
            if rows:
                with files.whole(self._folder / "curve.png") as part:
                    plot_curve(rows, part)

    def _write_events(self, row: Row) -> None:
        EventsWriter, Event, SessionLog, scalar = _tensorboard()
        if self._events is None:
            folder = self._folder / "tensorboard"
            folder.mkdir(parents=True, exist_ok=True)
            self._events = EventsWriter(str(folder / "events"))
            # Hides what an earlier process logged after this step.
            start = Event(wall_time=time.time(), step=int(row["steps"]), session_log=SessionLog(status=SessionLog.START))
            self._events.write_event(start)
        for name, value in row.items():
            if value is not None:
                self._events.write_event(Event(wall_time=time.time(), step=int(row["steps"]), summary=scalar(name, value)))
        self._events.flush()

    @contextlib.contextmanager
    def _expendable(self, name: str, kinds: tuple[type[Exception], ...] = (OSError, UserError)) -> Iterator[None]:
        try:
            yield
        except kinds as error:
            if not self.lost:
                reason = " ".join(str(getattr(error, "strerror", None) or error).split())
                self._warn(f"warning: cannot write {name} in {self._folder} ({reason}): training continues without it")
            self.lost[name] = self.lost.get(name, 0) + 1


def read(path: pathlib.Path) -> list[Row]:
    """Reads the rows of a run. A rewound run logged some steps twice; the later rows count."""
    rows: list[Row] = []
    if not path.is_file():
        return rows
    for text in files.read_bytes(path, MAX_METRICS).splitlines():
        row = _row(text)
        if row:  # None: a half-written line of a killed run
            while rows and rows[-1]["steps"] >= row["steps"]:
                rows.pop()
            rows.append(row)
    return rows


def _row(text: bytes) -> Row | None:
    """Parses a row of metrics by name; None if the line is not one."""
    try:
        row = files.parse_json(text)
    except (ValueError, RecursionError):
        return None
    numbers = isinstance(row, dict) and all(value is None or type(value) in (int, float) for value in row.values())
    return row if numbers and row.get("steps") is not None else None


@functools.cache
def _tensorboard() -> tuple[Any, ...]:
    """Imports TensorBoard's writer without PyTorch, which takes seconds, and which numbers do without."""
    with imports.replaced({"torch": None}):
        from tensorboardX.event_file_writer import EventsWriter
        from tensorboardX.proto.event_pb2 import Event, SessionLog
        from tensorboardX.summary import scalar
    return EventsWriter, Event, SessionLog, scalar


def _append(path: pathlib.Path, text: str) -> None:
    """Appends a line, and first ends an unfinished last line."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("ab+") as file:
        if file.tell():
            file.seek(-1, 2)
            text = text if file.read(1) == b"\n" else f"\n{text}"
        file.write(f"{text}\n".encode())


def plot_curve(rows: list[Row], path: pathlib.Path) -> None:
    """Plots success, return and every reward term over env steps."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 3.8), layout="constrained")
    success, returns, terms = figure.subplots(1, 3)

    def line(axes, name, **style):
        points = [(row["steps"] / 1e6, row[name]) for row in rows if row.get(name) is not None]
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
        axes.locator_params(axis="x", nbins=6)
        axes.grid(alpha=0.3)
        if axes.get_legend_handles_labels()[0]:
            axes.legend(fontsize=7, loc="upper left")  # matplotlib takes seconds to find the best place
    success.set_ylim(-0.02, 1.02)
    figure.savefig(path, dpi=110)
