"""Turns a task's metrics into figures over many episodes, each as its term says (``MetricTerm``)."""

from collections.abc import Iterator, Mapping

import numpy as np

from mjx_nero.mdp.terms import MetricTerm

Terms = Mapping[str, MetricTerm]  # by name


def of_episodes(terms: Terms, metrics: Mapping[str, np.ndarray], whole: np.ndarray) -> dict[str, float | None]:
    """Computes the figures of a set of episodes.

    A non-finite episode counts as an episode without the event of a rate, and is excluded from means.

    Args:
        metrics: name -> values of the episodes [n].
        whole: which episodes stayed finite, bool [n].

    Returns:
        ``<figure>_mean`` or ``<figure>_rate``; the mean of no episode is None.
    """
    return {f"{term.figure or name}_{term.over}": _figure(term, metrics, name, whole) for name, term in terms.items()}


def _figure(term: MetricTerm, metrics: Mapping[str, np.ndarray], name: str, whole: np.ndarray) -> float | None:
    if term.over == "rate":
        return float(((metrics[name] > 0) & whole).mean())
    return mean(metrics[name][(metrics[term.where] > 0) & whole if term.where else whole])


def of_sums(terms: Terms, sums: Mapping[str, float], episodes: float) -> Iterator[tuple[str, float]]:
    """Yields (name, figure) of the episodes that ended while metrics were summed.

    Rates have the metric's name, means the figure's.

    Args:
        sums: name -> sum over all steps and environments.
        episodes: number of ended episodes.
    """
    for name, term in terms.items():
        if term.at_end and name in sums:
            count = max(sums[term.where], 1e-9) if term.where else episodes
            yield (name if term.over == "rate" else term.figure or name), sums[name] / count


def mean(values: np.ndarray) -> float | None:
    """Returns the mean, or None for an empty array."""
    return float(values.mean()) if values.size else None
