"""Measures what MuJoCo alone takes for the steps of a data set: the floor of ``demos``, in the cores' time.

python tests/tools/physics_alone.py demos/many
"""

import argparse
import pathlib
import time

import mujoco
import numpy as np
from mujoco import rollout

from mjx_nero import cores
from mjx_nero.data import Episode, open_dataset, units
from mjx_nero.data.episode import EXECUTED, QPOS
from mjx_nero.envs.env import ManipulationEnv
from mjx_nero.tools.demos import making


def play(env: ManipulationEnv, of: units.Units, episodes: list[Episode]) -> float:
    """Steps episodes of one length side by side by the targets that their drives were told; returns the cores' seconds."""
    model, n = env.physics_model, len(episodes)
    start = np.zeros((n, 1 + model.nq + model.nv))
    start[:, 1 : 1 + model.nq] = [episode.arrays[QPOS][0] for episode in episodes]
    targets = np.stack([of.positions(episode.arrays[EXECUTED]) for episode in episodes]).repeat(env.cfg.sim.decimation, axis=1)
    data = [mujoco.MjData(model) for _ in range(cores())]
    with rollout.Rollout(nthread=len(data)) as physics:
        begun = time.process_time()
        physics.rollout([model] * n, data, start, targets.astype(np.float64))
        return time.process_time() - begun


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=pathlib.Path, help="a data set of an environment")
    parser.add_argument("--most", type=int, default=512, help="episodes to play")
    args = parser.parse_args()
    found = open_dataset(args.folder)
    env, of = making.env_of(found.schema, drives=True), units.from_json(found.schema.about["units"])
    episodes = found.episodes([EXECUTED, QPOS])[: args.most]
    alike: dict[int, list[Episode]] = {}
    for episode in episodes:
        alike.setdefault(len(episode), []).append(episode)
    spent = sum(play(env, of, each) for each in alike.values())
    steps = sum(map(len, episodes))
    each, step = 1e3 * spent / len(episodes), 1e6 * spent / steps
    print(f"{len(episodes)} episodes, {steps} steps: {each:.1f} ms an episode, {step:.1f} us a step")


if __name__ == "__main__":
    main()
