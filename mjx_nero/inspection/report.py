"""A robot in its scene, an environment, all environments: as values and as a picture."""

import dataclasses
import pathlib
import pkgutil
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_nero import config, policy, registry, render, scene, tasks
from mjx_nero.env import EnvCfg, ManipulationEnv
from mjx_nero.inspection.contacts import Pair, constraint_rows, contact_pairs
from mjx_nero.robots import Range, RobotCfg
from mjx_nero.scene import SceneCfg, SimCfg
from mjx_nero.terms import Term
from mjx_nero.types import UserError


@dataclasses.dataclass(frozen=True)
class Joint:
    """A joint; gains, effort, speed and home are None where no drive turns it.

    Attributes:
        kind: ``hinge``, ``slide``, ...
        range: limits [rad or m]; None: unlimited.
        follows: the joint that it is coupled to, or empty.
        group: ``arm``, ``gripper`` or empty.
    """

    name: str
    kind: str
    range: Range | None
    follows: str
    group: str
    home: float | None = None
    stiffness: float | None = None
    damping: float | None = None
    effort: float | None = None
    speed: float | None = None


@dataclasses.dataclass(frozen=True)
class Actuator:
    """A position drive: bounds of its target [rad or m] and of its force [N m or N]; None: unbounded."""

    name: str
    joint: str
    target: Range | None
    force: Range | None


@dataclasses.dataclass(frozen=True)
class Task:
    """What an environment adds to its robot; texts for people."""

    env: str
    preset: str
    episode_s: float
    control_dt: float
    action: str
    action_size: int
    command: str
    observations: dict[str, dict[str, int]]
    rewards: dict[str, float]
    terminations: dict[str, str]
    events: dict[str, str]


@dataclasses.dataclass(frozen=True)
class Report:
    """A robot in its scene.

    Attributes:
        open, close: targets of the gripper's joints, in their order [rad or m].
        gaps: between the pads, open and closed [m]; None: unknown, or no gripper.
        sites: name -> position at home, world frame [m].
        masses: body -> [kg], the robot's alone.
        pairs: geoms that can meet.
        rows: constraint rows of one environment at worst, by kind.
        contacts_per_env, constraints_per_env: what MJX-Warp's buffers hold.
        task: of an environment.
    """

    robot: str
    joints: tuple[Joint, ...]
    open: tuple[float, ...]
    close: tuple[float, ...]
    gaps: Range | None
    actuators: tuple[Actuator, ...]
    sites: dict[str, tuple[float, float, float]]
    masses: dict[str, float]
    gravity_compensation: bool
    pairs: tuple[Pair, ...]
    rows: dict[str, int]
    contacts_per_env: int
    constraints_per_env: int
    task: Task | None = None

    @property
    def contacts(self) -> int:
        """Candidate contacts of one environment at worst."""
        return sum(pair.contacts for pair in self.pairs)


@dataclasses.dataclass(frozen=True)
class Environment:
    """A line of ``list-envs``; an environment for any robot has no robot and no sizes of its own."""

    name: str
    task: str
    robot: str | None
    presets: tuple[str, ...]
    action_size: int | None
    observation_sizes: dict[str, int]
    policy: bool


def find(name: str, preset: str | None = None, robot: str | None = None) -> tuple[RobotCfg, EnvCfg | None]:
    """A robot, and the environment if ``name`` is one.

    Args:
        name: of a robot or an environment, or the folder of an imported robot.
        preset, robot: of an environment.

    Raises:
        UserError: no such thing, or a robot with a preset or another robot.
    """
    if name in registry.list_envs():
        cfg = registry.env_cfg(name, preset or registry.list_presets(name)[0], robot)
        return cfg.robot, cfg
    known = (*registry.list_robots(), *registry.list_envs())
    if name not in known and not pathlib.Path(name).is_dir():
        hint = config.hint(name, known)
        raise UserError(f"no robot or environment {name!r}{hint}: choose one of {', '.join(known)}, or the folder of a robot")
    if preset or robot:
        raise UserError(f"{name} is a robot: --preset and --robot go with an environment")
    return registry.robot(name), None


def inspect(name: str, preset: str | None = None, robot: str | None = None) -> Report:
    """Everything about a robot at a table with a cube, or about an environment; see ``find``."""
    arm, cfg = find(name, preset, robot)
    report = inspect_robot(arm, cfg.scene if cfg else SceneCfg(), cfg.sim if cfg else SimCfg())
    return dataclasses.replace(report, task=_task(name, preset, cfg) if cfg else None)


def inspect_robot(robot: RobotCfg, objects: SceneCfg, sim: SimCfg) -> Report:
    """A robot in a scene."""
    model = scene.build(robot, objects, sim, visuals=False)
    data, gripper = mujoco.MjData(model), robot.gripper
    for joint, position in zip(robot.joints, robot.home, strict=True):
        data.joint(joint).qpos[0] = position
    mujoco.mj_forward(model, data)
    bodies = [model.body(b) for b in range(1, model.nbody) if model.body(b).name not in ("cube", "goal")]
    gaps = None
    if gripper.joints and gripper.gap:
        gaps = (float(gripper.gap(jnp.array(gripper.open))), float(gripper.gap(jnp.array(gripper.close))))
    return Report(
        robot=robot.name,
        joints=tuple(_joints(model, robot)),
        open=gripper.open,
        close=gripper.close,
        gaps=gaps,
        actuators=tuple(_actuators(model)),
        sites={model.site(s).name: tuple(map(float, data.site_xpos[s])) for s in range(model.nsite)},  # type: ignore[misc]
        masses={body.name: float(body.mass[0]) for body in bodies},
        gravity_compensation=robot.gravity_compensation,
        pairs=contact_pairs(model),
        rows=constraint_rows(model),
        contacts_per_env=sim.contacts_per_env,
        constraints_per_env=sim.constraints_per_env,
    )


def environments() -> tuple[Environment, ...]:
    """All environments; nothing is compiled."""
    names = [module.name for module in pkgutil.iter_modules(tasks.__path__)]
    out = []
    for env_name in registry.list_envs():
        task = next((t for t in names if env_name.endswith(t)), env_name)
        presets = registry.list_presets(env_name)
        try:
            env = ManipulationEnv(registry.env_cfg(env_name), impl="jax")
        except UserError:  # it has no robot of its own
            out.append(Environment(env_name, task, None, presets, None, {}, policy=False))
            continue
        sizes = {group: env.observation_size[group][0] for group in env.cfg.observations}
        shipped = policy.shipped(env_name).is_file()
        out.append(Environment(env_name, task, env.cfg.robot.name, presets, env.action_size, sizes, shipped))
    return tuple(out)


def draw(robot: RobotCfg, cfg: EnvCfg | None = None, width: int = 960, height: int = 720) -> np.ndarray:
    """Picture of the robot at home, in its environment if there is one; uint8 [height, width, 3].

    Raises:
        UserError: the machine cannot draw offscreen.
    """
    if cfg:
        env = ManipulationEnv(cfg, impl="jax")
        sim, carry = env.draw(jax.random.PRNGKey(0))
        with render.Renderer(env.mj_model, width, height) as renderer:
            goal = np.concatenate([carry.command + jnp.asarray(robot.base_pos), carry.command_quat])
            return renderer.draw(np.asarray(sim.qpos), goal)
    low, high = _extent(robot)
    far = 1.5 * float(np.linalg.norm(high - low))
    objects = SceneCfg(cube=False, look_at=tuple((low + high) / 2), view_distance=far, table_center=tuple((low + high)[:2] / 2))
    model = scene.build(robot, objects, SimCfg())
    qpos = model.qpos0.copy()
    qpos[[model.joint(j).qposadr[0] for j in robot.joints]] = robot.home
    with render.Renderer(model, width, height) as renderer:
        return renderer.draw(qpos, np.array([0.0, 0.0, -1.0]))  # the goal marker: under the table


def _joints(model: mujoco.MjModel, robot: RobotCfg) -> Iterator[Joint]:
    coupled = model.eq_type == mujoco.mjtEq.mjEQ_JOINT
    leaders = dict(zip(model.eq_obj1id[coupled], model.eq_obj2id[coupled], strict=True))
    driven: dict[str, tuple] = {}
    for group, drive in (("arm", robot.arm), ("gripper", robot.gripper)):
        rows = zip(drive.home, drive.stiffness, drive.damping, drive.effort, drive.speed, strict=True)
        driven |= {name: (group, *row) for name, row in zip(drive.joints, rows, strict=True)}
    ids = [model.joint(name).id for name in driven]
    for j in (*ids, *(j for j in range(model.njnt) if j not in ids and model.joint(j).name != "cube")):
        name, leader = model.joint(j).name, leaders.get(j, -1)
        yield Joint(
            name,
            mujoco.mjtJoint(model.jnt_type[j]).name.removeprefix("mjJNT_").lower(),
            _bounds(model.jnt_range[j]) if model.jnt_limited[j] else None,
            model.joint(leader).name if leader >= 0 else "",
            *driven.get(name, ("",)),
        )


def _actuators(model: mujoco.MjModel) -> Iterator[Actuator]:
    for i in range(model.nu):
        target = _bounds(model.actuator_ctrlrange[i]) if model.actuator_ctrllimited[i] else None
        force = _bounds(model.actuator_forcerange[i]) if model.actuator_forcelimited[i] else None
        yield Actuator(model.actuator(i).name, model.joint(model.actuator_trnid[i, 0]).name, target, force)


def _bounds(pair) -> Range:
    return float(pair[0]), float(pair[1])


def _extent(robot: RobotCfg) -> tuple[np.ndarray, np.ndarray]:
    """Corners of a box around the robot at home, world frame [m]."""
    model = scene.robot_model(robot)
    data = mujoco.MjData(model)
    data.qpos[[model.joint(j).qposadr[0] for j in robot.joints]] = robot.home
    mujoco.mj_kinematics(model, data)
    reach = np.minimum(model.geom_rbound, 0.1)[:, None]  # bounding spheres of long shapes would say too much
    points = data.geom_xpos if model.ngeom else data.xpos
    reach = reach if model.ngeom else 0.05
    return (points - reach).min(axis=0), (points + reach).max(axis=0)


def _task(name: str, preset: str | None, cfg: EnvCfg) -> Task:
    env = ManipulationEnv(cfg, impl="jax")
    sizes = jax.eval_shape(lambda key: env.named_observations(env.reset(key)), jax.random.PRNGKey(0))
    if cfg.action.absolute:
        action = "one position target a drive [rad or m]"
    else:
        action = f"{len(cfg.robot.arm.joints)} arm joints: home + {cfg.action.scale:g} x action [rad]"
        if env.action_size > len(cfg.robot.arm.joints):
            action += "; the last one closes the gripper where negative, else opens it"
    action += f"; clipped to +-{cfg.action.clip:g}" if cfg.action.clip else ""
    return Task(
        env=name,
        preset=preset or registry.list_presets(name)[0],
        episode_s=cfg.episode_length_s,
        control_dt=env.dt,
        action=action,
        action_size=env.action_size,
        command=f"{_call(cfg.command)}, every {cfg.command.resample_s:g} s"
        if cfg.command.resample_s < cfg.episode_length_s
        else f"{_call(cfg.command)}, once an episode",
        # In the config's order: what JAX returns is sorted.
        observations={g: {term: sizes[g][term].size for term in group} for g, group in cfg.observations.items()},
        rewards={term: reward.weight for term, reward in cfg.rewards.items()},
        terminations={term: _call(done) + (", a time-out" if done.time_out else "") for term, done in cfg.terminations.items()},
        events={term: _call(event) for term, event in cfg.events.items()},
    )


def _call(term: Term) -> str:
    return f"{term.func.__name__}({', '.join(f'{name}={value}' for name, value in term.params.items())})"
