"""Opens a data set with LeRobot's own ``LeRobotDataset``: python lerobot_check.py FOLDER. It imports nothing of this package.

Every step comes back, 50 random ones equal what lies in ``recorded.npz`` beside them bit for bit (if there is one), and
statistics equal recomputed ones to 1e-5.
"""

import json
import os
import pathlib
import sys

os.environ["HF_HUB_OFFLINE"] = "1"

import numpy as np
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset

STATISTICS = {
    "min": lambda x: x.min(0),
    "max": lambda x: x.max(0),
    "mean": lambda x: x.mean(0),
    "std": lambda x: x.std(0),
    "q01": lambda x: np.quantile(x, 0.01, axis=0),
    "q50": lambda x: np.quantile(x, 0.5, axis=0),
    "q99": lambda x: np.quantile(x, 0.99, axis=0),
}


def step_picture(frame):
    """A picture as it was given: height, width, colours."""
    return frame.permute(1, 2, 0).numpy()


def main(folder: pathlib.Path) -> None:
    """Prints what was compared, as JSON; fails where something differs."""
    found = LeRobotDataset("mjx_nero/demos", root=folder, video_backend="pyav")
    info = found.meta.info
    names = [name for name, feature in found.features.items() if feature["dtype"] in ("float32", "bool")]
    together = {name: [] for name in names}
    for i in range(len(found)):
        step = found[i]
        assert int(step["index"]) == i
        for name in names:
            together[name].append(step[name])
    arrays = {name: torch.stack(x).numpy().reshape(len(found), -1).astype(np.float64) for name, x in together.items()}

    worst = 0.0
    for name, x in arrays.items():
        for what, compute in STATISTICS.items():
            off = np.abs(np.ravel(found.meta.stats[name][what]) - compute(x)) / np.maximum(1, np.abs(x).max(0))
            worst = max(worst, float(off.max()))
    assert worst < 1e-5, worst
    for name in (name for name, feature in found.features.items() if feature["dtype"] == "video"):
        drawn = np.stack([step_picture(found[i][name]) for i in range(0, len(found), max(1, len(found) // 50))])
        assert drawn.min() >= 0 and drawn.max() <= 1 and drawn.shape[1:] == tuple(found.features[name]["shape"])

    read_back = 0
    if (folder / "recorded.npz").exists():
        recorded = np.load(folder / "recorded.npz")
        for i in np.random.default_rng(0).integers(len(found), size=50):
            step = found[int(i)]
            for name in recorded.files:
                own = np.asarray(step[name]).reshape(-1)
                assert (own == recorded[name][i]).all(), (name, i)
            read_back += 1
    episodes = int(found.num_episodes)
    print(
        json.dumps({"episodes": episodes, "steps": len(found), "worst": worst, "read_back": read_back, "task": found[0]["task"]})
    )
    assert episodes == (info["total_episodes"] if isinstance(info, dict) else info.total_episodes)


if __name__ == "__main__":
    main(pathlib.Path(sys.argv[1]))
