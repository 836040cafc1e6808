"""Dumps what every environment and preset does for 100 random actions in MuJoCo's C library, and compares two such dumps.

    python tests/envs/dump_presets.py dump FOLDER [NAME ...] [--bare]
    python tests/envs/dump_presets.py compare FOLDER OTHER

No test: it tells whether a change of the code left the tasks as they were, bit for bit. Run ``dump`` before and after the change,
each with the package of its own checkout on ``PYTHONPATH``. Environments for any robot are dumped for two of them. ``--bare``
leaves out what version 0.5.0 cannot tell: the named observations and what a picture shows.
"""

import os

os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "true")  # compiling would take nearly all of the time
os.environ.setdefault("JAX_PLATFORMS", "cpu")

import argparse
import pathlib
import sys
import time

import jax
import numpy as np

import mjx_nero
from mjx_nero.envs import wrappers
from mjx_nero.tasks import registry

STEPS, NUM_ENVS = 100, 4
EPISODE_S = 1.5  # [s] shorter than 100 control steps: episodes end and start anew
ROBOTS = ("nero", "so_arm101")  # of environments for any robot


def cases() -> list[tuple[str, str, str | None]]:
    """Environment, preset and robot (None: the environment's own) of all that there are."""
    found = []
    for env in registry.list_envs():
        robots = ROBOTS if registry.robot_of(env) is None else (None,)
        found += [(env, preset, robot) for preset in registry.list_presets(env) for robot in robots]
    return found


def played(env_name: str, preset: str, robot: str | None, bare: bool = False) -> dict[str, np.ndarray]:
    """Name -> array [steps, environments, ...] of all that a learner sees of an environment, and of what its drives do."""
    env = mjx_nero.make(env_name, preset, impl="native", num_envs=NUM_ENVS, robot=robot, episode_length_s=EPISODE_S)
    train_env = wrappers.for_training(env)

    def seen(state):
        sim = state.pipeline_state
        more = {} if bare else {"scenery": jax.vmap(env.scenery)(state), "exact": env.named_observations(state)}
        return {
            "obs": state.obs,
            "reward": state.reward,
            "done": state.done,
            "metrics": state.metrics,
            "truncation": state.info["truncation"],
            "ctrl": sim.ctrl,
            "qpos": sim.qpos,
            "qvel": sim.qvel,
            "fields": sim.fields,
            **more,
        }

    step = jax.jit(train_env.step)
    look = jax.jit(seen)
    state = jax.jit(train_env.reset)(jax.random.split(jax.random.PRNGKey(0), NUM_ENVS))
    actions = jax.random.normal(jax.random.PRNGKey(1), (STEPS, NUM_ENVS, env.action_size))
    frames = [jax.device_get(look(state))]
    for action in actions:
        state = step(state, action)
        frames.append(jax.device_get(look(state)))
    stacked = jax.tree.map(lambda *each: np.stack(each), *frames)
    leaves, _ = jax.tree_util.tree_flatten_with_path(stacked)
    return {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}


def dump(folder: pathlib.Path, names: list[str], bare: bool = False) -> None:
    """Writes a file a case, of all cases or those whose name contains one of ``names``; those that exist are kept."""
    folder.mkdir(parents=True, exist_ok=True)
    for env, preset, robot in cases():
        name = "-".join(filter(None, (env, preset, robot)))
        path = folder / f"{name}.npz"
        if path.exists() or names and not any(each in name for each in names):
            continue
        begun = time.monotonic()
        try:
            arrays = played(env, preset, robot, bare)
        except mjx_nero.UserError as error:
            arrays = {"error": np.array(str(error))}
        np.savez(path.with_suffix(".part.npz"), **arrays)
        path.with_suffix(".part.npz").rename(path)
        print(f"{name}: {len(arrays)} arrays, {time.monotonic() - begun:.1f} s", flush=True)


def compare(folder: pathlib.Path, other: pathlib.Path) -> int:
    """Prints what differs; the number of cases that do."""
    ours, theirs = ({path.name for path in each.glob("*.npz")} for each in (folder, other))
    if ours ^ theirs:
        print(f"in one folder alone: {', '.join(sorted(ours ^ theirs))}")
    differing = len(ours ^ theirs)
    for name in sorted(ours & theirs):
        a, b = np.load(folder / name), np.load(other / name)
        found = [f"{key}: in one alone" for key in sorted(set(a) ^ set(b))]
        for key in sorted(set(a) & set(b)):
            if a[key].shape != b[key].shape or a[key].dtype != b[key].dtype:
                found.append(f"{key}: {a[key].dtype}{a[key].shape} and {b[key].dtype}{b[key].shape}")
            elif a[key].tobytes() != b[key].tobytes():
                steps = np.flatnonzero([x.tobytes() != y.tobytes() for x, y in zip(a[key], b[key], strict=True)])
                found.append(f"{key}: from step {steps[0]} on" if a[key].ndim else f"{key}: {a[key]} and {b[key]}")
        if found:
            differing += 1
            print(f"{name}: {len(found)} of {len(a.files)} differ; {'; '.join(found[:4])}")
    print(f"{len(ours & theirs)} cases compared, {differing} differ")
    return differing


def main() -> None:
    """See the top."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    dumps = commands.add_parser("dump")
    dumps.add_argument("folder", type=pathlib.Path)
    dumps.add_argument("names", nargs="*")
    dumps.add_argument("--bare", action="store_true")
    compares = commands.add_parser("compare")
    compares.add_argument("folder", type=pathlib.Path)
    compares.add_argument("other", type=pathlib.Path)
    args = parser.parse_args()
    if args.command == "dump":
        dump(args.folder, args.names, args.bare)
    else:
        sys.exit(bool(compare(args.folder, args.other)))


if __name__ == "__main__":
    main()
