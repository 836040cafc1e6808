"""Replays an episode of a data set: sends the recorded drive targets again and compares the simulated states."""

import dataclasses
import pathlib

from mjx_nero.sim.quiet import State

import jax
import jax.numpy as jnp
import numpy as np

from mjx_nero.data import Dataset, Episode, open_with, units
from mjx_nero.data import episode as names
from mjx_nero.envs.env import ManipulationEnv
from mjx_nero.errors import UserError
from mjx_nero.imitation.recording.demonstrations import start
from mjx_nero.runs import console, videos
from mjx_nero.tools.demos import making
from mjx_nero.types import Scenery


def show(path: pathlib.Path, index: int, video: pathlib.Path | None) -> None:
    """Prints how far the replay differs from the recording, and draws the episode if a video is requested.

    Raises:
        UserError: there is no such episode, or the data set is not from an environment.
    """
    found = open_with(path, index)
    env, episode = making.env_of(found.schema, drives=True), _episode(found, index)
    qpos, scenery = again(env, found, episode)
    off = np.abs(qpos - episode.arrays[names.QPOS]).max()
    screen = console.screen()
    said = "succeeds" if episode.success else "fails"
    console.line(screen, f"episode {index} (number {episode.number}): {len(episode)} steps, {said}; {found.schema.task}")
    console.line(screen, f"the replay differs from the recording by at most {off:.2g} (rad, m)")
    if video:
        with console.drawing(console.screen(stderr=True), video.name) as update:
            drawn = episode.arrays[names.QPOS].astype(np.float64)[:, None]
            cfg = videos.VideoCfg(in_turn=1)
            videos.write_episodes(video, env.mj_model, drawn, scenery[:, None], env.dt, cfg, update)
        console.wrote(screen, "video", video)


def _episode(found: Dataset, index: int) -> Episode:
    """Returns one episode with the features that a replay needs.

    Raises:
        UserError: the data set lacks them.
    """
    if names.QPOS not in found.schema.features:
        raise UserError("this data set has no simulated positions: replay one that 'demos' wrote with --holds all")
    known = [name for name in (names.EXECUTED, names.QPOS, names.ENVIRONMENT) if name in found.schema.features]
    return found.episodes(known)[index]


def again(env: ManipulationEnv, found: Dataset, episode: Episode) -> tuple[np.ndarray, Scenery]:
    """Replays an episode; returns positions before each step [steps, nq], and everything else that a picture shows.

    Args:
        env: with drive targets as actions.
    """
    targets = units.from_json(found.schema.about["units"]).positions(episode.arrays[names.EXECUTED])

    @jax.jit
    def play(targets):
        def step(state, target):
            return env.step(state, target), (state.pipeline_state.qpos, env.scenery(state))

        return jax.lax.scan(step, _begin(env, found, episode), targets)[1]

    return jax.device_get(play(jnp.asarray(targets, jnp.float32)))


def _begin(env: ManipulationEnv, found: Dataset, episode: Episode) -> State:
    """Returns the first state of an episode. A demonstration by hand has no seed: it starts at rest in its first pose."""
    about = found.schema.about
    if "seed" in about:
        return start(env, episode.number, about["seed"])
    state = env.reset(jax.random.PRNGKey(0))
    at = found.schema.features[names.ENVIRONMENT].names.index("goal.x")
    pos, quat = np.split(episode.arrays[names.ENVIRONMENT][0, at : at + 7], [3])
    carry = state.info["carry"].replace(command=pos - np.asarray(env.cfg.robot.base_pos, np.float32), command_quat=quat)
    sim = dataclasses.replace(state.pipeline_state, qpos=jnp.asarray(episode.arrays[names.QPOS][0]))
    return state.replace(pipeline_state=sim, info={**state.info, "carry": carry})
