"""Statistics of features, as LeRobot's readers and learners want them: exact, of all steps."""

import numpy as np

QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
SAMPLES = 100  # pictures of an episode that its statistics are of, at most, as LeRobot has them
Stats = dict[str, np.ndarray]


def of(values: np.ndarray) -> Stats:
    """Statistics over the steps: minimum, maximum, mean, standard deviation, number and quantiles.

    A quantile is interpolated between the two nearest steps, as ``numpy.quantile`` does.

    Args:
        values: [steps, numbers].

    Returns:
        name -> [numbers], float64; of ``count`` [1], int64.
    """
    ordered = np.sort(values.T.astype(np.float32), axis=1)  # along contiguous memory
    mean, std = ordered.mean(axis=1, dtype=np.float64), ordered.std(axis=1, dtype=np.float64)
    out = {"min": ordered[:, 0].astype(np.float64), "max": ordered[:, -1].astype(np.float64), "mean": mean, "std": std}
    for name, share in QUANTILES.items():
        at = share * (len(values) - 1)
        low = int(at)
        high = min(low + 1, len(values) - 1)
        ends = ordered[:, [low, high]].astype(np.float64)
        out[name] = ends[:, 0] + (at - low) * (ends[:, 1] - ends[:, 0])
    return {**out, "count": np.array([len(values)])}


def of_pictures(frames: list[np.ndarray]) -> Stats:
    """The same of pictures' colours, over all pixels, from 0 to 1.

    Args:
        frames: uint8 [height, width, 3] each.

    Returns:
        name -> [3]; of ``count`` [1], pictures.
    """
    found = of(np.concatenate([frame.reshape(-1, 3) for frame in frames]) / np.float32(255))
    return {**found, "count": np.array([len(frames)])}


def sampled(length: int) -> set[int]:
    """The steps of an episode whose pictures are in its statistics."""
    return set(np.linspace(0, length - 1, min(length, SAMPLES)).round().astype(int).tolist())


def together(parts: list[Stats]) -> Stats:
    """Statistics of all from those of the parts; quantiles, which cannot be had so, are means of theirs, as LeRobot has them."""
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
