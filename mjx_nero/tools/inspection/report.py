"""Describes a robot in its scene, or an environment, as values and as a picture."""

import dataclasses
import pathlib
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_nero import config
from mjx_nero.config import docs, values
from mjx_nero.config.bounds import Range
from mjx_nero.envs.env import ManipulationEnv
from mjx_nero.envs.task import EnvCfg
from mjx_nero.mdp.terms import Term
from mjx_nero.sim import grasp, linkage, render, scene, team
from mjx_nero.sim.contacts import Pair, constraint_rows, contact_pairs, sized
from mjx_nero.sim.robot import Box, RobotCfg
from mjx_nero.sim.scene import ObjectCfg, SceneCfg, SimCfg
from mjx_nero.tasks import registry
from mjx_nero.types import UserError


@dataclasses.dataclass(frozen=True)
class Joint:
    """A joint; gains, effort, speed and home are None if it has no drive.

    Attributes:
        kind: ``hinge``, ``slide``, ...
        range: limits [rad or m]; None: unlimited.
        follows: the joint that it is coupled to, or empty.
        group: ``arm``, ``gripper``, a group of another robot, or empty.
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
    """An environment's part of the report, as text."""

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
    objects: dict[str, str]


@dataclasses.dataclass(frozen=True)
class Report:
    """A robot in its scene.

    Attributes:
        open, close: targets of the gripper's joints, in order [rad or m].
        gaps: distance between the pads, open and closed [m]; None: unknown, or no gripper.
        room: ``opening`` of an imported robot: less than the open gap if a jaw swings out to the side [m]; 0: unknown.
        regions: ``workspace``, ``pick`` and ``hold`` of ``RobotCfg``, if it has them: ranges of x, y and z [m].
        sites: name -> position at home, world frame [m].
        masses: body -> mass [kg], of the robot only.
        pairs: geoms that can touch.
        rows: maximum number of constraint rows of one environment, by kind.
        contacts_per_env, constraints_per_env: capacity of MJX-Warp's buffers.
        task: the environment's part; None for a robot.
    """

    robot: str
    joints: tuple[Joint, ...]
    open: tuple[float, ...]
    close: tuple[float, ...]
    gaps: Range | None
    room: float
    regions: dict[str, Box]
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
        """Maximum number of candidate contacts of one environment."""
        return sum(pair.contacts for pair in self.pairs)


def find(name: str, preset: str | None = None, robot: str | None = None) -> tuple[RobotCfg, EnvCfg | None]:
    """Returns a robot, and the environment if ``name`` is one.

    Args:
        name: robot, environment, or folder of an imported robot.
        preset, robot: of an environment.

    Raises:
        UserError: the name is unknown, or names a robot and a preset or another robot is given.
    """
    if name in registry.list_envs():
        cfg = registry.env_cfg(name, preset or registry.list_presets(name)[0], robot)
        return cfg.robot, cfg
    known = (*registry.list_robots(), *registry.list_envs())
    if name not in known and not pathlib.Path(name).is_dir():
        hint = config.hint(name, known)
        raise UserError(f"no robot or environment {name!r}{hint}: {values.choices(name, known)}, or the folder of a robot")
    if preset or robot:
        raise UserError(f"{name} is a robot: leave out --preset and --robot, which are for environments")
    return registry.robot(name), None


def inspect(name: str, preset: str | None = None, robot: str | None = None) -> Report:
    """Reports everything about a robot at a table with a cube, or about an environment; see ``find``."""
    arm, cfg = find(name, preset, robot)
    sim = cfg.sim if cfg else sized(arm, SceneCfg(), SimCfg()) if arm.folder else SimCfg()
    report = inspect_robot(arm, cfg.scene if cfg else SceneCfg(), sim)
    return dataclasses.replace(report, task=_task(name, preset, cfg) if cfg else None)


def inspect_robot(robot: RobotCfg, where: SceneCfg, sim: SimCfg) -> Report:
    """Reports a robot in a scene, which may have other robots."""
    model, robots = scene.build(robot, where, sim, visuals=False), team.of(robot, where.robots)
    data, gripper = mujoco.MjData(model), robot.gripper
    for joint, position in zip(team.joints(robots), team.home(robots), strict=True):
        data.joint(joint).qpos[0] = position
    mujoco.mj_forward(model, data)
    others = {*where.objects, *where.fixtures, "goal", "obstacles", "fixtures"}
    bodies = [body for body in map(model.body, range(1, model.nbody)) if body.name.partition("/")[0] not in others]
    formulas, gaps = grasp.formulas(robot), None
    if formulas:
        gaps = (float(formulas[0](jnp.array(gripper.open))), float(formulas[0](jnp.array(gripper.close))))
    return Report(
        robot=", ".join([robot.name, *(f"{other.name} as {name}" for name, other in where.robots.items())]),
        joints=tuple(_joints(model, robots, where)),
        open=gripper.open,
        close=gripper.close,
        gaps=gaps,
        room=robot.opening if robot.folder else 0.0,
        regions={name: box for name in ("workspace", "pick", "hold") if (box := getattr(robot, name))},
        actuators=tuple(_actuators(model)),
        sites={model.site(s).name: tuple(map(float, data.site_xpos[s])) for s in range(model.nsite)},  # type: ignore[misc]
        masses={body.name: float(body.mass[0]) for body in bodies},
        gravity_compensation=robot.gravity_compensation,
        pairs=contact_pairs(model),
        rows=constraint_rows(model),
        contacts_per_env=sim.contacts_per_env,
        constraints_per_env=sim.constraints_per_env,
    )


def picture(robot: RobotCfg, cfg: EnvCfg | None = None, width: int = 960, height: int = 720) -> np.ndarray:
    """Draws the robot at home, in its environment if one is given; uint8 [height, width, 3].

    Raises:
        UserError: the machine cannot draw offscreen.
    """
    if cfg:
        env = ManipulationEnv(cfg, impl="native")
        state = jax.jit(env.reset)(jax.random.PRNGKey(0))
        qpos, scenery = jax.device_get((state.pipeline_state.qpos, env.scenery(state)))
        with render.Renderer(env.mj_model, width, height) as renderer:
            return renderer.render(qpos, scenery)
    low, high = _extent(robot)
    far = 1.5 * float(np.linalg.norm(high - low))
    objects = SceneCfg(objects={}, table_center=tuple((low + high)[:2] / 2))
    objects = dataclasses.replace(scene.around(robot, objects), look_at=tuple((low + high) / 2), view_distance=far)
    model = scene.build(robot, objects, SimCfg())
    qpos = model.qpos0.copy()
    qpos[[model.joint(j).qposadr[0] for j in robot.joints]] = robot.home
    with render.Renderer(model, width, height) as renderer:
        return renderer.render(qpos, render.unmarked())


def _joints(model: mujoco.MjModel, robots: team.Robots, where: SceneCfg) -> Iterator[Joint]:
    joint_at = {int(at): j for j, at in enumerate(model.jnt_qposadr)}
    leaders = {joint_at[c.follower]: joint_at[c.leader] for c in linkage.couplings(model) if c.leader != c.follower}
    driven: dict[str, tuple] = {}
    for group, drive in team.drives(robots).items():
        rows = zip(drive.home, drive.stiffness, drive.damping, drive.effort, drive.speed, strict=True)
        driven |= {name: (group, *row) for name, row in zip(drive.joints, rows, strict=True)}
    ids = [model.joint(name).id for name in driven]
    for j in (*ids, *(j for j in range(model.njnt) if j not in ids and model.joint(j).name not in where.objects)):
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
    """Returns two corners of a box around the robot at home, world frame [m]."""
    model, data = scene.at_home(robot)
    reach = np.minimum(model.geom_rbound, 0.1)[:, None]  # bounding spheres of long shapes are too large
    points = data.geom_xpos if model.ngeom else data.xpos
    reach = reach if model.ngeom else 0.05
    away = np.linalg.norm(points - data.xpos[1], axis=1)
    near = away <= max(3 * np.median(away), 1.0)  # some makers' meshes have stray parts metres away
    points, reach = points[near], np.broadcast_to(reach, (len(points), 1))[near]
    return (points - reach).min(axis=0), (points + reach).max(axis=0)


def _task(name: str, preset: str | None, cfg: EnvCfg) -> Task:
    env = ManipulationEnv(cfg, impl="native")
    sizes = jax.eval_shape(lambda key: env.named_observations(env.reset(key)), jax.random.PRNGKey(0))
    action = "; ".join(f"{_call(term)}: {_summary(term)}" for term in cfg.actions.values())
    action += f"; clipped to +-{cfg.action_clip:g}" if cfg.action_clip else ""
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
        observations={g: {term: sizes[g][term].size for term in group.terms} for g, group in cfg.observations.items()},
        rewards={term: reward.weight for term, reward in cfg.rewards.items()},
        terminations={term: _call(done) + (", a time-out" if done.time_out else "") for term, done in cfg.terminations.items()},
        events={term: _call(event) for term, event in cfg.events.items()},
        objects={name: _object(item) for name, item in cfg.scene.objects.items()},
    )


def _object(item: ObjectCfg) -> str:
    if item.shape == "mesh":
        return f"mesh, {' or '.join((item.file, *item.bank))}, {' or '.join(f'{mass:.3g}' for mass in item.masses)} kg"
    return f"{item.shape}, {' x '.join(f'{x:g}' for x in item.size)} m, {item.mass:g} kg"


def _summary(term: Term) -> str:
    """Returns the first sentence of a term's docstring, with a small first letter, to follow a colon."""
    text = docs.summary(term.func).partition(". ")[0].replace("``", "")
    return text[:1].lower() + text[1:]


def _call(term: Term) -> str:
    return f"{term.name}({', '.join(f'{name}={value}' for name, value in term.params.items())})"
