"""Teachers: policies that observe directly what the student must see."""

import pathlib
from collections.abc import Mapping
from typing import Any

from mjx_nero.envs.env import ManipulationEnv
from mjx_nero.errors import UserError
from mjx_nero.learn import checkpoint, header, policy
from mjx_nero.sim.fingerprint import fingerprint
from mjx_nero.sim.robot import ASSETS

USUAL = 1  # greatest delay of actions by default [control steps]
GROUP = "teacher"  # the observation group that the teacher reads as its ``state``


def find(env: ManipulationEnv, given: str = "") -> policy.Policy:
    """Finds the teacher's policy.

    Args:
        given: the policy's file; empty: the bundled policy with the same robot, observations and actions. If actions are
            delayed, that of the preset ``sim2real``, or else of the default one if the delay is the default's.

    Raises:
        UserError: there is no such policy, or it does not fit.
    """
    if GROUP not in env.cfg.observations:
        raise UserError(f"distillation needs the observation group {GROUP!r}, which the teacher reads: pass --preset rgb")
    if given:
        found = policy.load(pathlib.Path(given))
        if fault := _misfit(found.meta, env):
            raise UserError(f"{given} cannot teach here: {fault}")
        return found
    bundled = [(checkpoint.load_meta(path), path) for path in sorted((ASSETS / "policies").glob("*.safetensors"))]
    wanted = _presets(env)
    able = [path for preset in wanted for meta, path in bundled if meta["preset"] == preset and not _misfit(meta, env)]
    if not able:
        raise UserError(
            f"no bundled policy can teach {env.cfg.robot.name} this task: train one with the task's preset {wanted[-1]}, and "
            "pass --distill.teacher RUN/policy.safetensors"
        )
    return policy.load(able[0])


def _presets(env: ManipulationEnv) -> tuple[str, ...]:
    """Lists presets whose policies can teach, the best first."""
    delay = env.cfg.actions.get("delay")
    latest = max(delay.params["steps"]) if delay else 0
    return ("default",) if not latest else ("sim2real", "default") if latest <= USUAL else ("sim2real",)


def _misfit(meta: Mapping[str, Any], env: ManipulationEnv) -> str:
    """Says why the policy cannot label; empty if it can."""
    robot, told = env.cfg.robot, list(env.cfg.observations[GROUP].terms)
    if meta.get("robot") != robot.name or meta.get("fingerprint") != fingerprint(robot):
        return f"it is for another robot ({meta.get('robot')}; here {robot.name})"
    if meta["observations"]["state"] != told or meta["observation_size"]["state"] != list(env.observation_size[GROUP]):
        return f"it reads other observations (here {', '.join(told)})"
    if meta["action_size"] != env.action_size or not header.acts_alike(meta, {"actions": env.action_kinds}):
        return "it has other actions"
    return ""
