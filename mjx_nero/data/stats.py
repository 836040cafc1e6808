"""Statistics of features as LeRobot's readers and learners expect them, computed exactly from all steps."""

import numpy as np
from PIL import Image

QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
SAMPLES = 100  # maximum number of pictures in an episode's statistics, as in LeRobot
TOGETHER = 16  # episodes of equal length whose statistics are computed at once, so that they fit into a processor's cache
Stats = dict[str, np.ndarray]


def of(values: np.ndarray) -> Stats:
    """Computes statistics over the steps: minimum, maximum, mean, standard deviation, count and quantiles.

    A quantile is interpolated between the two nearest steps, as ``numpy.quantile`` does.

    Args:
        values: [..., steps, numbers].

    Returns:
        name -> [..., numbers], float64; ``count`` is [1], int64.
    """
    rows = np.ascontiguousarray(np.asarray(values, np.float32).swapaxes(-1, -2))  # what follows runs along memory
    n = rows.shape[-1]
    at = {name: (int(share * (n - 1)), share * (n - 1) % 1) for name, share in QUANTILES.items()}
    mean = rows.mean(axis=-1, dtype=np.float64)
    out = {"mean": mean, "std": rows.std(axis=-1, dtype=np.float64)}
    rows.sort(axis=-1)  # vectorized sorting is faster than a partition at twelve places
    out |= {"min": rows[..., 0].astype(np.float64), "max": rows[..., -1].astype(np.float64)}
    for name, (low, between) in at.items():
        ends = (rows[..., i].astype(np.float64) for i in (low, min(low + 1, n - 1)))
        first, second = ends
        out[name] = first + between * (second - first)
    return {**out, "count": np.array([n])}


def of_each(values: np.ndarray, lengths: np.ndarray) -> Stats:
    """Computes the statistics of ``of`` for each episode.

    Args:
        values: [steps, numbers], episode by episode.
        lengths: number of steps of each episode [n].

    Returns:
        name -> [n, numbers]; ``count`` is [n, 1].
    """
    begins, out = np.cumsum(lengths) - lengths, dict[str, np.ndarray]()
    for length in np.unique(lengths):
        alike = np.flatnonzero(lengths == length)
        for which in np.array_split(alike, -(-len(alike) // TOGETHER)):
            found = of(values[begins[which, None] + np.arange(length)])
            found["count"] = np.full((len(which), 1), length)
            for name, x in found.items():
                out.setdefault(name, np.empty((len(lengths), x.shape[1]), x.dtype))[which] = x
    return out


def of_pictures(frames: list[np.ndarray]) -> Stats:
    """Computes the statistics of ``of`` for pictures' colours, from 0 to 1, over all pixels.

    Args:
        frames: uint8 [height, width, 3] each.

    Returns:
        name -> [3]; ``count`` is [1], the number of pictures.
    """
    pixels = np.concatenate(frames)  # one tall picture, which Pillow counts in a third of NumPy's time
    counts = np.reshape(Image.fromarray(pixels).histogram(), (3, 256)).T  # [values, colours]
    values, n, upto = np.arange(256)[:, None] / 255, pixels.size // 3, counts.cumsum(axis=0)
    mean = (counts * values).sum(axis=0) / n

    def sorted_value(rank: int) -> np.ndarray:
        return (upto <= rank).sum(axis=0) / 255

    out = {"mean": mean, "std": np.sqrt((counts * (values - mean) ** 2).sum(axis=0) / n)}
    out |= {"min": sorted_value(0), "max": sorted_value(n - 1)}
    for name, share in QUANTILES.items():
        low, between = divmod(share * (n - 1), 1)
        first, second = sorted_value(int(low)), sorted_value(min(int(low) + 1, n - 1))
        out[name] = first + between * (second - first)
    return {**out, "count": np.array([len(frames)])}


def sampled(length: int) -> set[int]:
    """Returns the steps of an episode whose pictures are in its statistics."""
    return set(np.linspace(0, length - 1, min(length, SAMPLES)).round().astype(int).tolist())


def together(parts: list[Stats]) -> Stats:
    """Combines the statistics of parts. Quantiles cannot be combined exactly: they are means of the parts', as in LeRobot."""
    count = np.array([part["count"][0] for part in parts], float)
    share = (count / count.sum())[:, None]
    mean, std = (np.stack([part[name] for part in parts]) for name in ("mean", "std"))
    whole = (share * mean).sum(axis=0)
    out = {
        "min": np.min([part["min"] for part in parts], axis=0),
        "max": np.max([part["max"] for part in parts], axis=0),
        "mean": whole,
        "std": np.sqrt((share * (std**2 + (mean - whole) ** 2)).sum(axis=0)),
    }
    out |= {name: (share * np.stack([part[name] for part in parts])).sum(axis=0) for name in QUANTILES}
    return {**out, "count": np.array([int(count.sum())])}
