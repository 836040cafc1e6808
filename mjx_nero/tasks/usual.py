"""The usual parts of tasks, to put one together from: actions, observations, events, rewards, and settings of learners."""

from collections.abc import Callable, Mapping
from typing import Any

from mjx_nero.config.bounds import NonNegative, Range, Steps
from mjx_nero.envs.task import SuccessCfg
from mjx_nero.mdp import actions, curriculum, events, observations, success, terminations
from mjx_nero.mdp.terms import DoneTerm, ObservationGroup, ObservationTerm, RewardTerm, Term, groups
from mjx_nero.sim.scene import SceneCfg

# Learner settings for velocity actions: noise of at most half an action, and a cost on changes of the action.
CALM = {"network.init_std": 0.5, "max_std": 0.5, "change_cost": 0.03}
# The policy starts as a clone of the task's scripted expert. At first only its critic learns.
SHOWN = {**CALM, "imitation": 1.0, "critic_first": 20}
# For tasks that bear no noise: little of it, nothing that pays for it, and more demonstrations, which last. Single policies still
# come and go in them, so the mean of the newest ones is played.
PRECISE = {
    **SHOWN,
    "averaging": 0.95,
    "min_std": 0.05,
    "max_std": 0.1,
    "entropy_cost": 0.0,
    "demonstrations": 256,
    "imitation": 20.0,
    "imitation_lasts": True,
}


def velocity_actions(gripper: bool = True, late: Steps = (0, 1), hysteresis: NonNegative = 0.0) -> dict[str, Term]:
    """Lists action terms: one entry per arm joint (its velocity; +-1 is the drive's limit), and one for the gripper, if any.

    Actions are late by a number of control steps that each episode draws from ``late``, as on a real arm. ``hysteresis`` is that
    of the gripper (``mdp.actions.BinaryGripper``).
    """
    grip = Term(actions.BinaryGripper, params={"hysteresis": hysteresis})
    hand = {"gripper": grip, "speed_limit": Term(actions.SpeedLimit, params={"group": "gripper"})}
    return {
        "delay": Term(actions.Delay, params={"steps": late}),
        "arm": Term(actions.JointVelocity),
        **(hand if gripper else {}),
    }


def arm_state() -> dict[str, ObservationTerm]:
    """Lists the observations of the arm itself: joints, how far targets lead them, and the grasp point."""
    return {
        "joint_pos": ObservationTerm(observations.joint_pos_rel, noise=0.01),
        "joint_vel": ObservationTerm(observations.joint_vel_rel, noise=0.01),
        "target_error": ObservationTerm(observations.target_error),
        "ee_position": ObservationTerm(observations.ee_position),
    }


def observed(state: Mapping[str, ObservationTerm], **object: str) -> dict[str, ObservationGroup]:
    """Groups the observations of a policy, and those of a critic that also knows the object's velocity."""
    velocity = ObservationTerm(observations.object_velocity, params=object)
    return groups(state, {"object_velocity": velocity})


def on_table(ranges: tuple[Range, Range], **object: str) -> dict[str, Term]:
    """Lists the event that puts the object on the table, at uniform x and y in the world [m]."""
    place = {"x": ranges[0], "y": ranges[1], "z": (0.0, 0.0), **object}
    return {"reset_object_position": Term(events.object_position_uniform, params=place)}


def stays_on_table(scene: SceneCfg, **object: str) -> dict[str, DoneTerm]:
    """Lists the terminations: the time is up, or the object has left the table."""
    table = {"center": scene.table_center, "size": scene.table_size, **object}
    return {
        "time_out": DoneTerm(terminations.time_out, time_out=True),
        "object_off_table": DoneTerm(terminations.object_off_table, params=table),
    }


def nearer(name: str, func: Callable, **params: Any) -> dict[str, RewardTerm]:
    """Lists three rewards of one distance, on scales of 0.3, 0.1 and 0.03 m: the closer, the steeper.

    Args:
        func: a term that takes ``std``, and ``params``.
    """
    scales = {name: (10.0, 0.3), f"{name}_near": (10.0, 0.1), f"{name}_fine": (15.0, 0.03)}
    return {each: RewardTerm(func, weight=weight, params={"std": std, **params}) for each, (weight, std) in scales.items()}


def step_weights(num_steps: int, **to: float) -> dict[str, Term]:
    """Lists curriculum terms that set weights of rewards after ``num_steps`` control steps (``mdp.curriculum.step_weight``)."""
    return {name: Term(curriculum.step_weight, params={"to": weight, "num_steps": num_steps}) for name, weight in to.items()}


def object_at_goal(**object: str) -> SuccessCfg:
    """Makes the success of carrying: the object is within 2 cm of the goal."""
    condition = Term(success.object_at_goal, params={"threshold": 0.02, **object})
    return SuccessCfg(condition=condition, distance=Term(success.object_distance, params=object))
