"""Tables and pictures of a data set."""

import itertools
import pathlib

import imageio.v3 as imageio
import numpy as np

from mjx_nero import files
from mjx_nero.data import Dataset, open_dataset, stats
from mjx_nero.data import episode as names
from mjx_nero.errors import UserError
from mjx_nero.runs import console

BINS, SHEET = 16, 24  # bins of a histogram; episodes on a sheet
_BARS = " ▁▂▃▄▅▆▇█"
_SHOWN = (names.STATE, names.ACTION, names.ENVIRONMENT)


def show(path: pathlib.Path, picture: pathlib.Path | None = None) -> None:
    """Prints counts, lengths and the distribution of states and actions, and draws a sheet of pictures if asked.

    Raises:
        UserError: there is no data set, it is damaged, or a sheet is asked for and it has no pictures.
    """
    found, screen = open_dataset(path), console.screen()
    if picture:
        with files.whole(picture) as part:
            imageio.imwrite(part, sheet(path, found))
    screen.print(overview(path, found))
    for name in _SHOWN:
        if name in found.schema.features:
            screen.print(distribution(found, name))
    if picture:
        console.wrote(screen, "pictures", picture)


def sheet(path: pathlib.Path, found: Dataset) -> np.ndarray:
    """Draws the beginning, middle and end of the first episodes by each camera, in rows; uint8 [height, width, 3].

    Raises:
        UserError: there are no pictures.
    """
    cameras = [name for name, feature in found.schema.features.items() if feature.picture]
    if not cameras:
        raise UserError(f"{path} has no pictures: write it with --cameras")
    lengths = found.lengths[:SHEET]
    ends = np.cumsum(lengths)
    wanted = {int(at): None for end, n in zip(ends, lengths, strict=True) for at in (end - n, end - n + n // 2, end - 1)}
    columns = []
    for name in cameras:
        frames = enumerate(itertools.islice(found.frames(name), int(ends[-1])))
        kept = {i: frame for i, frame in frames if i in wanted}
        columns.append(np.stack([kept[i] for i in wanted]).reshape(len(lengths), 3, *next(iter(kept.values())).shape))
    rows = np.concatenate(columns, axis=1)  # [episodes, cameras x 3, height, width, 3]
    n, across, height, width, _ = rows.shape
    beside = max(1, round((n * height / (across * width)) ** 0.5))  # episodes per row, for an about square sheet
    rows = np.concatenate([rows, np.zeros((-n % beside, *rows.shape[1:]), np.uint8)]).reshape(
        -1, beside * across, height, width, 3
    )
    return rows.swapaxes(1, 2).reshape(-1, beside * across * width, 3)


def overview(path: pathlib.Path, found: Dataset) -> console.Table:
    """Lists how a data set was made, its size and the lengths of its episodes."""
    schema, lengths = found.schema, found.lengths
    about = schema.about
    table = console.Table(str(path), ("", ""), left=("",))
    table.add("task", schema.task)
    for name in ("env", "preset", "agent", "through", "noise", "actions", "seed", "version"):
        if name in about:
            table.add(name, str(about[name]))
    table.add("robot", f"{schema.robot}, {schema.fps:g} steps a second")
    played = int(found.numbers.max()) + 1 if len(found) else 0
    table.add("episodes", f"{len(found)}, of which {int(found.success.sum())} succeed ({played} were played)")
    table.add("steps", f"{int(lengths.sum())}, {lengths.sum() / schema.fps / 3600:.2f} h")
    if len(found):
        shown = f"{lengths.min()} to {lengths.max()} steps, {lengths.mean():.1f} on average"
        table.add("lengths", f"{shown}  {histogram(lengths)}")
    if names.ACTION in schema.features and names.EXECUTED in schema.features and schema.about.get("actions") != "hand":
        off = found.column(names.ACTION) - found.column(names.EXECUTED)
        table.add("deviation", f"{off.std():.4g} (of executed actions from their labels, standard deviation over all joints)")
    return table


def distribution(found: Dataset, name: str) -> console.Table:
    """Makes a table with one row for each number of a feature."""
    feature, values = found.schema.features[name], found.column(name)
    table = console.Table(name, ("", "unit", "min", "1%", "mean", "99%", "max", "std", "histogram"), left=("histogram",))
    of = stats.of(values)
    for i, number in enumerate(feature.names):
        cells = [f"{of[what][i]:.4g}" for what in ("min", "q01", "mean", "q99", "max", "std")]
        table.add(number, feature.units[i] if feature.units else "", *cells, histogram(values[:, i]))
    return table


def histogram(values: np.ndarray) -> str:
    """Draws a histogram from the least to the greatest value as text; every bin that is not empty shows."""
    counts, _ = np.histogram(values.astype(np.float64), BINS)
    heights = np.ceil(counts / max(1, counts.max()) * (len(_BARS) - 1)).astype(int)
    return "".join(_BARS[height] for height in heights)
