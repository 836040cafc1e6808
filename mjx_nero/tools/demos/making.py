"""Makes the player and the schema of a data set."""

import argparse
import dataclasses
import hashlib
import math
import pathlib
from typing import Any

import jax
import numpy as np

import mjx_nero
from mjx_nero import config, files
from mjx_nero.data import Feature, Schema, units
from mjx_nero.data import episode as names
from mjx_nero.envs import things
from mjx_nero.envs.env import ManipulationEnv
from mjx_nero.envs.task import EnvCfg, drive_targets, for_controllers
from mjx_nero.errors import UserError
from mjx_nero.imitation.distill import teachers
from mjx_nero.imitation.recording import demonstrations, pictures
from mjx_nero.imitation.recording.demonstrations import Player
from mjx_nero.imitation.recording.pictures import Cameras
from mjx_nero.learn import bundled, policy
from mjx_nero.learn.play import rollout
from mjx_nero.runs import evaluation
from mjx_nero.runs.evaluation_cfg import controller_of
from mjx_nero.sim import team
from mjx_nero.sim.fingerprint import fingerprint
from mjx_nero.tasks import registry
from mjx_nero.tools import cli
from mjx_nero.tools.demos.cfg import DemosCfg

HOPELESS = 1000  # episodes in a row without a success
ARM = (names.STATE, names.ACTION, names.EXECUTED, names.DONE)  # what a real arm can log
HOLDS = {"arm": ARM, "lerobot": (names.STATE, names.ENVIRONMENT, names.ACTION)}  # what LeRobot's policies learn from
SENTENCES = {  # by the end of an environment's name, longest first
    "reach_obstacles": "Bring the hand to the goal without touching an obstacle.",
    "lift_obstacles": "Pick up the cube and carry it past the obstacles to the goal.",
    "pick_place": "Pick up the cube and put it down at the goal.",
    "follow_target": "Follow the moving goal with the hand.",
    "clutter": "Pick the commanded object out of the others and hold it at the goal.",
    "stack": "Put the cube on top of the other cube and let go.",
    "place": "Put the cube down at the goal and let go.",
    "push": "Push the object to the goal.",
    "reach": "Bring the hand to the goal.",
    "lift": "Pick up the cube and hold it at the goal.",
}


def blind(cfg: EnvCfg, renderer: str) -> EnvCfg:
    """Returns the config of an environment that observes no pictures. It draws nothing as it steps.

    Args:
        renderer: renderer of the pictures that are drawn afterwards; the other one may be missing.
    """
    kept = {name: group for name, group in cfg.observations.items() if name in ("state", teachers.GROUP)}
    scene = dataclasses.replace(cfg.scene, renderer=pictures.chosen(renderer))  # pictures that no term reads are not drawn
    return dataclasses.replace(cfg, observations=kept, scene=scene)


def prepare(cfg: DemosCfg) -> tuple[Schema, Player]:
    """Returns the schema of the data set and the player of its episodes.

    Raises:
        UserError: a name or field is unknown, or the policy does not fit.
    """
    env_cfg = registry.env_cfg(cfg.env_name, cfg.preset, cfg.robot).uncorrupted()
    env_cfg = things.overridden(env_cfg, cfg.env_fields)
    name = controller_of(cfg.agent, env_cfg.controllers)
    acts = name is None
    size = min(cfg.side_by_side, cfg.episodes)
    drives = not acts and cfg.through == "drives"
    told = not cfg.policy and teachers.GROUP in env_cfg.observations  # the agent is told what others must see
    env_cfg = blind(env_cfg, cfg.renderer) if not acts or told else env_cfg
    env = ManipulationEnv(for_controllers(env_cfg) if drives else env_cfg, impl="native", num_envs=size)
    if acts and told:
        teacher = teachers.find(env)
        agent = rollout.policy_agent(lambda params, obs, key: teacher.act({"state": obs[teachers.GROUP]}))
    elif name is None:
        trained = policy.load_for(env, cfg.env_name, cfg.policy, cfg.robot, preset=cfg.preset)
        agent = rollout.policy_agent(lambda params, obs, key: trained.act(obs))
    else:
        steering = evaluation.controller(name, env, cfg.env_name)
        agent = rollout.controller_agent(env, steering)
        agent = agent if drives else rollout.through_actions(env, agent)
    shown, cameras = units_of(env, cfg.units), cameras_of(env, cfg)
    about = {
        "env": cfg.env_name,
        "preset": cfg.preset,
        "robot": env.cfg.robot.name,
        "robot_folder": env.cfg.robot.folder,
        "fingerprint": fingerprint(env.cfg.robot),
        "env_fields": {key: str(value) for key, value in cfg.env_fields.items()},
        "agent": "policy" if acts else name,
        "policy": _digest(cfg.policy or bundled.shipped(cfg.env_name, cfg.preset)) if acts else None,
        "through": "task" if acts else cfg.through,
        "seed": cfg.seed,
        "all": cfg.all,
        "ends": cfg.ends,
        "noise": cfg.noise,
        "actions": cfg.actions,
        "holds": cfg.holds,
        "cameras": cfg.cameras,
        "renderer": cameras.renderer if cameras else None,
        "units": shown.to_json(),
        "impl": env.impl,
        "version": mjx_nero.__version__,
    }
    usual = features(env, shown, cfg.actions, bool(cameras), cfg.velocities)
    held = {name: each for name, each in usual.items() if name in HOLDS.get(cfg.holds, usual)}
    if cameras:
        held |= {names.PICTURES + name: names.picture(*size[::-1]) for name, size in cameras.sizes.items()}
    schema = Schema(1 / env.dt, robot_type(env.cfg.robot.name, shown), cfg.task or sentence(cfg.env_name), held, about)
    early = cfg.ends == "success"
    deltas = cfg.actions == "hand"
    return schema, Player(env, agent, shown, size, tuple(held), deltas, cfg.noise, cameras, early, cfg.velocities)


def cameras_of(env: ManipulationEnv, cfg: DemosCfg) -> Cameras | None:
    """Returns the requested cameras; None if there are none.

    Raises:
        UserError: a camera does not exist, the picture size is invalid, or the machine cannot draw.
    """
    found = list(dict.fromkeys(name.strip() for name in cfg.cameras.split(",") if name.strip()))
    try:
        size = cli.size(cfg.picture) if cfg.picture else None
    except argparse.ArgumentTypeError as error:
        raise UserError(f"--picture {error}") from None
    return Cameras(env, found, size, cfg.renderer) if found else None


def robot_type(robot: str, shown: units.Units) -> str:
    """Returns the robot's name: LeRobot's if the units are LeRobot's."""
    return units.LEROBOT.get(robot, robot) if shown.kind == "lerobot" else robot


def sentence(env_name: str) -> str:
    """Returns a sentence that says what the robot does in an environment."""
    return next((text for end, text in SENTENCES.items() if env_name.endswith(end)), f"Do {env_name.replace('_', ' ')}.")


def units_of(env: ManipulationEnv, kind: str) -> units.Units:
    """Returns the units of an environment's joints; ``kind`` is one of ``units.KINDS``, or ``auto``.

    Raises:
        UserError: the scene has several robots.
    """
    team.alone(env.cfg.scene.robots, "a data set of demonstrations")
    robot, model = env.cfg.robot, env.physics_model
    slides = [bool(model.joint(joint).type == 2) for joint in robot.joints]  # mjJNT_SLIDE
    if kind == "auto":
        kind = "lerobot" if robot.name in units.LEROBOT else "si"
    if kind == "si":
        return units.si(slides)
    low, high = np.array([model.joint(joint).range for joint in robot.joints]).T
    opens = np.array([open > close for open, close in zip(robot.gripper.open, robot.gripper.close, strict=True)])
    return units.lerobot(robot.name, slides, low, high, opens)


def features(
    env: ManipulationEnv, shown: units.Units, actions: str, seen: bool = False, velocities: bool = False
) -> dict[str, Feature]:
    """Returns the features of a step, without its pictures.

    Args:
        seen: the data set has pictures.
        velocities: the state has joint velocities.
    """
    joints = env.cfg.robot.joints
    targets = Feature(tuple(f"{joint}.pos" for joint in joints), shown.names)
    speeds = Feature(tuple(f"{joint}.vel" for joint in joints), tuple(f"{unit}/s" for unit in shown.names))
    moving = Feature(targets.names + speeds.names, targets.units + speeds.units)
    arm = len(env.cfg.robot.arm.joints)
    hand = tuple(f"hand.{what}" for what in ("x", "y", "z", "turn_x", "turn_y", "turn_z"))
    steps = Feature(hand + targets.names[arm:], ("m",) * 3 + ("rad",) * 3 + shown.names[arm:])
    things = demonstrations.told(env, seen)
    pose = [f"{thing}.{axis}" for thing in things for axis in ("x", "y", "z", "qw", "qx", "qy", "qz")]
    qpos = env.physics_model.nq
    return {
        names.STATE: moving if velocities else targets,
        names.ENVIRONMENT: Feature(tuple(pose), (("m",) * 3 + ("",) * 4) * len(things)),
        names.ACTION: steps if actions == "hand" else targets,
        names.EXECUTED: targets,
        names.SEEN: Feature(_seen(env)),
        names.DONE_BY: Feature(tuple(f"action.{i}" for i in range(env.action_size))),
        names.QPOS: Feature(tuple(f"qpos.{i}" for i in range(qpos))),
        names.REWARD: Feature(("reward",)),
        names.DONE: Feature(("done",), dtype="bool"),
        names.SUCCESS: Feature(("success",), dtype="bool"),
    }


def _seen(env: ManipulationEnv) -> tuple[str, ...]:
    """Names the numbers that a policy observes, after their terms if the terms' sizes add up."""
    shapes = jax.eval_shape(env.named_observations, env.state_shape)["state"]
    size = sum(
        math.prod(shape) for shape in jax.tree.leaves(env.observation_size["state"], is_leaf=lambda x: isinstance(x, tuple))
    )
    terms = env.cfg.observations["state"].terms  # in the config's order, which a JAX tree does not keep
    found = [f"{name}.{i}" for name in terms for i in range(shapes[name].size)]
    return tuple(found) if len(found) == size else tuple(f"state.{i}" for i in range(size))


def _digest(path: pathlib.Path) -> str:
    """Returns a hash that identifies the policy's file."""
    return hashlib.sha256(files.read_bytes(path, 1 << 30)).hexdigest()[:16]


def env_of(schema: Schema, drives: bool = False) -> ManipulationEnv:
    """Makes the environment in which a data set was recorded.

    Args:
        drives: act by drive targets, whatever the data set's agent acted through.

    Raises:
        UserError: it cannot be made on this machine.
    """
    about: dict[str, Any] = dict(schema.about)
    robot = about.get("robot_folder") or about["robot"]
    cfg = registry.env_cfg(about["env"], about["preset"], robot).uncorrupted()
    cfg = config.override(cfg, about.get("env_fields", {}))
    return ManipulationEnv(by_drives(cfg, about["through"]) if drives or about["through"] == "drives" else cfg, impl="native")


def by_drives(cfg: EnvCfg, through: str) -> EnvCfg:
    """Returns the task with drive targets as actions. An agent that acted through drives also had gravity compensated."""
    return for_controllers(cfg) if through == "drives" else dataclasses.replace(cfg, actions=drive_targets())
