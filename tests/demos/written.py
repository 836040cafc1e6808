"""Episodes made up for tests of data sets. Needs neither JAX nor pytest: processes that are to be killed start at once."""

import numpy as np

from mjx_nero.data import Episode, Feature, Schema


def schema(**about) -> Schema:
    features = {
        "observation.state": Feature(("a.pos", "b.pos"), ("rad", "m")),
        "action": Feature(("a.pos", "b.pos"), ("rad", "m")),
        "next.reward": Feature(("reward",)),
        "next.done": Feature(("done",), dtype="bool"),
    }
    return Schema(50.0, "nero", "Pick up the cube.", features, {"env": "nero_lift", "seed": 0, **about})


def episode(number: int, steps: int = 5) -> Episode:
    rng = np.random.default_rng(number)
    arrays = {name: rng.normal(size=(steps, 2)).astype(np.float32) for name in ("observation.state", "action")}
    done = np.arange(steps)[:, None] == steps - 1
    arrays["action"] = np.asfortranarray(arrays["action"])  # as a slice of something else may lie in the memory
    return Episode({**arrays, "next.reward": rng.random((steps, 1), np.float32), "next.done": done}, number % 3 > 0, number)
