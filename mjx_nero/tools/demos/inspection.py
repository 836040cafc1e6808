"""What a data set holds, for people."""

import pathlib

import numpy as np

from mjx_nero import console
from mjx_nero.data import Dataset, open_dataset, stats
from mjx_nero.data import episode as names

BINS = 16
_BARS = " ▁▂▃▄▅▆▇█"
_SHOWN = (names.STATE, names.ACTION, names.ENVIRONMENT)


def show(path: pathlib.Path) -> None:
    """Prints counts, lengths and the distribution of states and actions.

    Raises:
        UserError: there is no data set, or it is damaged.
    """
    found, screen = open_dataset(path), console.screen()
    screen.print(overview(path, found))
    for name in _SHOWN:
        if name in found.schema.features:
            screen.print(distribution(found, name))


def overview(path: pathlib.Path, found: Dataset) -> console.Table:
    """What it is and how much of it there is."""
    schema, lengths = found.schema, found.lengths
    about = schema.about
    table = console.Table(str(path), ("", ""), left=("",))
    table.add("task", schema.task)
    for name in ("env", "preset", "agent", "through", "noise", "actions", "seed", "version"):
        if name in about:
            table.add(name, str(about[name]))
    table.add("robot", f"{schema.robot}, {schema.fps:g} steps a second")
    played = int(found.numbers.max()) + 1 if len(found) else 0
    table.add("episodes", f"{len(found)}, of which {int(found.success.sum())} succeed (of {played} that were played)")
    table.add("steps", f"{int(lengths.sum())}, {lengths.sum() / schema.fps / 3600:.2f} h")
    if len(found):
        shown = f"{lengths.min()} to {lengths.max()} steps, {lengths.mean():.1f} on average"
        table.add("lengths", f"{shown}  {histogram(lengths)}")
    if names.ACTION in schema.features and names.EXECUTED in schema.features and schema.about.get("actions") != "hand":
        off = found.column(names.ACTION) - found.column(names.EXECUTED)
        table.add("noise done", f"{off.std():.4g} (deviation of what was done from the label, over all joints)")
    return table


def distribution(found: Dataset, name: str) -> console.Table:
    """A line a number of a feature."""
    feature, values = found.schema.features[name], found.column(name)
    table = console.Table(name, ("", "unit", "min", "1%", "mean", "99%", "max", "std", "histogram"), left=("histogram",))
    of = stats.of(values)
    for i, number in enumerate(feature.names):
        cells = [f"{of[what][i]:.4g}" for what in ("min", "q01", "mean", "q99", "max", "std")]
        table.add(number, feature.units[i] if feature.units else "", *cells, histogram(values[:, i]))
    return table


def histogram(values: np.ndarray) -> str:
    """Bars from the least to the greatest value; any that are there at all show."""
    counts, _ = np.histogram(values.astype(np.float64), BINS)
    heights = np.ceil(counts / max(1, counts.max()) * (len(_BARS) - 1)).astype(int)
    return "".join(_BARS[height] for height in heights)
