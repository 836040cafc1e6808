"""Policies: reading their files, and checking whether a policy fits an environment."""

import dataclasses
import functools
import pathlib
from collections.abc import Callable, Mapping
from typing import Any

import jax

from mjx_nero.envs.env import ManipulationEnv
from mjx_nero.errors import UserError
from mjx_nero.learn import checkpoint, header, learner
from mjx_nero.learn.bundled import shipped
from mjx_nero.learn.learner import Observation
from mjx_nero.sim.fingerprint import fingerprint


@dataclasses.dataclass(frozen=True)
class Policy:
    """A trained policy.

    Attributes:
        meta: its training: env, preset, robot, sizes, learner, env steps.
        params: its parameters. PPO's are (normalizer, network parameters), as Brax's inference function takes them.
        act: observation groups -> deterministic action; single or batched.
    """

    meta: dict[str, Any]
    params: Any
    act: Callable[[Observation], jax.Array]


def describe(env: ManipulationEnv, env_name: str, preset: str, by: str, learnt: Mapping[str, Any]) -> dict[str, Any]:
    """Describes a policy for its file.

    Args:
        by: the learner's name.
        learnt: result of ``Learner.describe``.
    """
    terms = {name: list(group.terms) for name, group in env.cfg.observations.items()}
    return {
        "kind": "policy",
        "env": env_name,
        "preset": preset,
        "robot": env.cfg.robot.name,
        "fingerprint": fingerprint(env.cfg.robot),
        "observation_size": jax.tree.map(list, env.observation_size, is_leaf=lambda node: isinstance(node, tuple)),
        "observations": terms,
        "action_size": env.action_size,
        "actions": env.action_kinds,
        "learner": by,
        **learnt,
    }


def checkpoint_policy(path: pathlib.Path | str) -> Policy:
    """Rebuilds the policy in a policy's file or a run's checkpoint, through the learner that the file names.

    Raises:
        UserError: the file is missing or damaged, or it describes no policy.
    """
    path = pathlib.Path(path)
    meta = checkpoint.load_meta(path)
    header.check(meta, path)
    whole, size = meta.get("kind") == "checkpoint", path.stat().st_size
    if not whole and size > header.MAX_POLICY:
        raise UserError(f"{path} has {size / 1e6:.0f} MB: policies above {header.MAX_POLICY / 1e6:.0f} MB are not read")
    kind = learner.find(meta.get("learner", "ppo"))
    if whole and not kind.held:
        raise UserError(
            f"{path} is a checkpoint, which the learner {meta['learner']} cannot play: give the run's policy.safetensors"
        )
    try:
        template, act = kind.policy(meta)
    except (KeyError, TypeError, AttributeError):
        raise UserError(f"{path} does not describe a policy: give the policy.safetensors of a run") from None
    params = checkpoint.load(path, template, kind.held if whole else {})
    checkpoint.check_finite(params, path)
    return Policy(meta=meta, params=params, act=functools.partial(act, params))


load = checkpoint_policy


def load_for(
    env: ManipulationEnv,
    env_name: str,
    path: pathlib.Path | str | None,
    robot: str | None = None,
    any_robot: bool = False,
    preset: str = "default",
) -> Policy:
    """Reads the policy at ``path`` (default: the bundled one) and checks that it fits ``env``.

    Args:
        preset: preset of the bundled policy, if it has its own.
        robot: the robot that the user named instead of the environment's own, for messages.
        any_robot: allow a policy that was trained for another model of the robot.

    Raises:
        UserError: the policy is missing, damaged, or trained on another environment, robot or observations.
    """
    path = pathlib.Path(path or shipped(env_name, preset))
    if path == shipped(env_name, preset) and not path.is_file():
        command = f"python train.py --env {env_name}" + (f" --robot {robot}" if robot else "")
        raise UserError(f"there is no bundled policy for {env_name}: train one ({command}) and pass --policy PATH")
    policy = checkpoint_policy(path)
    here = describe(env, env_name, preset, policy.meta.get("learner", "ppo"), {})
    if fault := misfit(policy.meta, here, any_robot):
        raise UserError(f"{path} {fault}")
    return policy


def misfit(there: Mapping[str, Any], here: Mapping[str, Any], any_robot: bool = False) -> str:
    """Says why a policy cannot be played in an environment, and what to do; empty if it can.

    Args:
        there: the description in the policy's file (``describe``). Older versions say less.
        here: the same for the environment.
        any_robot: allow another model of the robot.
    """
    kind, robot = there.get("kind", "policy"), here["robot"]
    if there["env"] != here["env"]:
        return f"is a {kind} of {there['env']}, not of {here['env']}: pass --env {there['env']}"
    if there.get("robot", robot) != robot:
        return f"is a {kind} for {there['robot']}, not for {robot}: pass the --robot that it was trained with"
    if not any_robot and there.get("fingerprint", here["fingerprint"]) != here["fingerprint"]:
        return (
            f"is a {kind} for another model of {robot} (other links, masses, joints or drives): pass the --robot "
            "or --env.identified that it was trained with, train one for this robot, or pass --any-robot to play it anyway"
        )
    if there["observations"]["state"] != here["observations"]["state"]:
        return f"was trained on other observations (preset {there['preset']}): pass --preset {there['preset']}"
    if there["action_size"] != here["action_size"]:
        count = f"{there['action_size']} actions, {robot} takes {here['action_size']}"
        return f"is of another robot ({count}): leave out --robot, or train one with it and pass --policy"
    if (sizes := [each["observation_size"]["state"] for each in (there, here)])[0] != sizes[1]:
        return (
            f"was trained on observations of size {sizes[0]}, but here it is {sizes[1]}: pass the --preset (it had "
            f"{there['preset']}) and the --env fields that it was trained with, or train one and pass --policy"
        )
    shapes = [each["observation_size"].get("pictures") for each in (there, here)]
    if shapes[0] and shapes[0] != shapes[1]:
        return (
            f"was trained on pictures of the shapes {shapes[0]}, but here they are {shapes[1] or 'none'}: pass the --preset "
            f"(it had {there['preset']}) and the --env.scene.cameras fields that it was trained with"
        )
    if not header.acts_alike(there, here):
        kinds = ", ".join(there.get("actions", ["JointPosition"]))
        return (
            f"was trained on other actions ({kinds}; here {', '.join(here['actions'])}): "
            "pass the --preset that it was trained with, or train again"
        )
    return ""
