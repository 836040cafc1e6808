"""Terminal output: lines, tables and progress. Words are never broken, however narrow the terminal."""

import contextlib
import dataclasses
import math
import os
import pathlib
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from rich import box, table
from rich.console import Console, ConsoleOptions
from rich.progress import BarColumn, Progress, TextColumn
from rich.text import Text

_GAP = 3  # maximum gap between two columns of a table
_WRAPPED = 30  # width that a column keeps when its text wraps
_BAR = (BarColumn(bar_width=14), TextColumn("{task.percentage:3.0f}%  {task.fields[text]}"))  # fits 80 columns


def screen(stderr: bool = False, quiet: bool = False) -> Console:
    """Makes a console for tables and lines, as wide as the terminal; without a terminal, wide enough for names."""
    console = Console(stderr=stderr, quiet=quiet)
    if not console.is_terminal and "COLUMNS" not in os.environ:
        console.width = 160  # a pipe has no width, and rich would use 80
    return console


def line(console: Console, text: str, style: str = "") -> None:
    """Prints a line unchanged: not wrapped, and not coloured by its content."""
    console.print(text, style=style, highlight=False, markup=False, soft_wrap=True)


def wrote(console: Console, what: str, path: pathlib.Path) -> None:
    """Prints where a file was written."""
    line(console, f"{what}: {path}")


@dataclasses.dataclass
class Table:
    """A table of text. Print it on a ``screen()``. If it is too wide, it is split into several, each with the first column.

    Attributes:
        columns: headings of the columns; if all are empty, there is no heading row.
        left: columns that are aligned left; the first column always is.
        wraps: columns whose text continues on the next line where the table is too wide.
    """

    title: str
    columns: Sequence[str]
    left: Sequence[str] = ()
    wraps: Sequence[str] = ()
    caption: str = ""
    rows: list[tuple[str, ...]] = dataclasses.field(default_factory=list)

    def add(self, *cells: str) -> None:
        """Adds a row."""
        self.rows.append(cells)

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[table.Table]:
        parts = self._parts(options.max_width)
        for part in parts:
            view = table.Table(
                title=Text(self.title if part is parts[0] else f"{self.title}, continued") if self.title else None,
                caption=Text(self.caption) if self.caption and part is parts[-1] else None,
                box=box.SIMPLE_HEAD,
                title_justify="left",
                caption_justify="left",
                collapse_padding=True,
                pad_edge=False,
                show_header=any(self.columns),
            )
            for i in part:
                name = self.columns[i]
                view.add_column(
                    Text(name), justify="left" if name in self.left or not i else "right", no_wrap=not i, overflow="fold"
                )
            for row in self.rows:
                view.add_row(*(Text(row[i]) for i in part))
            yield view

    def _parts(self, width: int) -> list[list[int]]:
        """Groups the columns so that each group fits the width."""
        widths = [
            max(len(line) for row in (self.columns, *self.rows) for line in row[i].split("\n")) for i in range(len(self.columns))
        ]
        widths = [min(n, _WRAPPED) if name in self.wraps else n for n, name in zip(widths, self.columns, strict=True)]
        parts, used = [[0]], widths[0]
        for i in range(1, len(widths)):
            if len(parts[-1]) > 1 and used + _GAP + widths[i] > width:
                parts.append([0])
                used = widths[0]
            parts[-1].append(i)
            used += _GAP + widths[i]
        return parts


def compiling(impl: str, on_cpu: bool) -> str:
    """Announces the wait before training."""
    first = "about half a minute" if impl == "native" else "a minute or two"
    if impl == "native" and not on_cpu:  # JAX's cache cannot hold an accelerator's programs that call back
        return f"compiling ({first}; programs that call MuJoCo's C library are compiled at every start) ..."
    return f"compiling ({first} the first time, a few seconds once the compiled programs are kept) ..."


def clock(seconds: float) -> str:
    """Formats seconds as hours, minutes and seconds."""
    seconds = round(seconds)
    minutes = f"{seconds % 3600 // 60:02}:{seconds % 60:02}"
    return f"{seconds // 3600}:{minutes}" if seconds >= 3600 else minutes


def time_left(steps: int, steps_per_s: float, minutes: float, wall: float) -> float:
    """Returns the seconds until the steps are made or the time limit is reached, whichever comes first.

    Args:
        steps: steps that are left.
        minutes: the run's time limit; 0: none.
        wall: training time so far [s].
    """
    left = steps / steps_per_s if steps_per_s else math.inf
    return max(0.0, min(left, 60 * minutes - wall) if minutes else left)


class Show:
    """The progress line of training."""

    def __init__(self, console: Console, total: int, max_minutes: float):
        self._console, self._total, self._max_minutes = console, total, max_minutes
        self._bar = Progress(*_BAR, console=console, disable=not console.is_terminal)
        self._task = self._bar.add_task("", total=1.0, text="")

    def __enter__(self) -> "Show":
        self._bar.__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        self._bar.__exit__(*error)

    def update(self, steps: int, wall: float, steps_per_s: float, success: float | None) -> None:
        """Shows progress after a chunk: the share of steps or of minutes, whichever is larger."""
        left = time_left(self._total - steps, steps_per_s, self._max_minutes, wall)
        text = f"{steps / 1e6:.1f}/{self._total / 1e6:.1f} M steps  {steps_per_s:,.0f}/s"
        text += "" if success is None else f"  success {success:.2f}"
        done = max(steps / self._total, wall / (60 * self._max_minutes) if self._max_minutes else 0.0)
        self._bar.update(self._task, completed=min(1.0, done), text=f"{text}  ETA {clock(left)}")

    def evaluated(self, steps: int, wall: float, evaluation: dict[str, Any]) -> None:
        """Prints a line about an evaluation, if the output is not a terminal."""
        if not self._console.is_terminal:
            text = f"{steps:>12,} steps {wall:7.1f} s  return {evaluation['return_mean'] or 0.0:8.2f}"
            line(self._console, f"{text}  success {evaluation['success_rate']:.3f}")


@contextlib.contextmanager
def drawing(console: Console, name: str) -> Iterator[Callable[[int, int], None]]:
    """Shows a progress line for a video. Yields a function to call with the number of frames drawn and of all frames."""
    with Progress(*_BAR, console=console, disable=not console.is_terminal, transient=True) as bar:
        task, begun = bar.add_task("", total=1.0, text=f"drawing {name}"), time.monotonic()

        def update(done: int, total: int) -> None:
            left = (time.monotonic() - begun) / done * (total - done) if done else 0.0
            bar.update(task, completed=done / total, text=f"drawing {name}, {done}/{total} frames  ETA {clock(left)}")

        yield update
