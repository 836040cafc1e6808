"""What a robot or an environment is made of: python -m mjx_nero inspect nero --move --render nero.png

``python -m mjx_nero list-envs`` lists the environments.
"""

import dataclasses
import itertools
import json
import pathlib
import pkgutil
from collections.abc import Iterator, Sequence
from typing import Any

import imageio.v3 as imageio
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from rich import box
from rich.table import Table

from mjx_nero import cli, config, policy, registry, render, run_folder, scene, tasks
from mjx_nero.env import EnvCfg, ManipulationEnv
from mjx_nero.robots import RobotCfg
from mjx_nero.scene import SceneCfg, SimCfg
from mjx_nero.terms import Term
from mjx_nero.types import UserError

Range = tuple[float, float]

# The most contacts that MuJoCo and MJX-Warp find between two shapes; a pair that is not listed goes by their general convex
# routine, which gives 4.
_MOST = {
    "plane": {"sphere": 1, "ellipsoid": 1, "capsule": 2, "cylinder": 4, "box": 4},
    "sphere": {"sphere": 1, "capsule": 1, "ellipsoid": 1, "cylinder": 1, "box": 1, "mesh": 1},
    "capsule": {"capsule": 2, "box": 2},
    "box": {"box": 8},
    "hfield": dict.fromkeys(("sphere", "capsule", "ellipsoid", "cylinder", "box", "mesh"), 50),
}
_CONVEX = 4
_EQUALITY_ROWS = {"CONNECT": 3, "WELD": 6, "JOINT": 1, "TENDON": 1}
_NEAR = 0.01  # of a joint's range: there, for ``moves``
_REST, _AFTER = 3.0, 4.0  # [s] before a movement, and after its target has arrived


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
class Pair:
    """Two geoms that can meet: the most contacts that their shapes make, and the constraint rows of all those."""

    first: str
    second: str
    shapes: str
    contacts: int
    condim: int
    rows: int


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
class Move:
    """A joint's way to a target that moves at the drive's speed limit.

    Attributes:
        start, target, end: positions [rad or m].
        time: until within 1% of the joint's range for good [s]; None: not there.
        fastest: [rad/s or m/s].
        saturation: share of the time that the drive pushed with all its effort.
    """

    joint: str
    start: float
    target: float
    end: float
    time: float | None
    fastest: float
    saturation: float


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


def contact_pairs(model: mujoco.MjModel) -> tuple[Pair, ...]:
    """The pairs of geoms that MuJoCo lets meet.

    Explicit pairs, and those whose contact bits match: unless of one body, of a body and its parent, or of excluded bodies.
    """
    explicit = {(int(a), int(b)): int(d) for a, b, d in zip(model.pair_geom1, model.pair_geom2, model.pair_dim, strict=True)}
    excluded = {(int(s) >> 16, int(s) & 0xFFFF) for s in model.exclude_signature}
    weld, pairs = model.body_weldid, []
    parents = not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_FILTERPARENT
    for a, b in itertools.combinations(range(model.ngeom), 2):
        if (a, b) in explicit or (b, a) in explicit:
            continue
        bodies = int(model.geom_bodyid[a]), int(model.geom_bodyid[b])
        wa, wb = (int(weld[body]) for body in bodies)
        related = wa and wb and (weld[model.body_parentid[wa]] == wb or weld[model.body_parentid[wb]] == wa)
        if wa == wb or (parents and related) or bodies in excluded or bodies[::-1] in excluded:
            continue
        if model.geom_contype[a] & model.geom_conaffinity[b] or model.geom_contype[b] & model.geom_conaffinity[a]:
            pairs.append((a, b, _condim(model, a, b)))
    pairs += [(a, b, dim) for (a, b), dim in explicit.items()]
    elliptic = model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    return tuple(_pair(model, a, b, dim, elliptic) for a, b, dim in pairs)


def constraint_rows(model: mujoco.MjModel) -> dict[str, int]:
    """Constraint rows at worst, by kind: all contacts made, every joint at a limit."""
    kinds = [mujoco.mjtEq(kind).name.removeprefix("mjEQ_") for kind in model.eq_type]
    return {
        "contacts": sum(pair.rows for pair in contact_pairs(model)),
        "joint limits": int(np.sum(model.jnt_limited != 0) + np.sum(model.tendon_limited != 0)),
        "joint friction": int(np.sum(model.dof_frictionloss > 0) + np.sum(model.tendon_frictionloss > 0)),
        "equalities": sum(_EQUALITY_ROWS.get(kind, 1) for kind in kinds),
    }


def moves(robot: RobotCfg, sim: SimCfg) -> tuple[Move, ...]:
    """Every joint to its limits and the gripper closed and opened, in MuJoCo's C library.

    Position targets change once a control step, at the drives' speed limits, as in an environment; contacts are off. One joint of
    the arm at a time, from home; the gripper's together, from the other end. A joint without limits is left out.
    """
    model = scene.build(robot, SceneCfg(cube=False, table=False), sim, visuals=False)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    home, n = np.array(robot.home), len(robot.arm.joints)
    out = []
    for i, name in enumerate(robot.arm.joints):
        for end in model.joint(name).range if model.jnt_limited[model.joint(name).id] else ():
            target = home.copy()
            target[i] = end
            out += _move(model, robot, sim, home, target, [i])
    if robot.gripper.joints:
        opened, closed = (np.concatenate([home[:n], ends]) for ends in (robot.gripper.open, robot.gripper.close))
        fingers = list(range(n, len(home)))
        out += _move(model, robot, sim, opened, closed, fingers) + _move(model, robot, sim, closed, opened, fingers)
    return tuple(out)


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
            return renderer.draw(np.asarray(sim.qpos), np.asarray(carry.command) + robot.base_pos)
    low, high = _extent(robot)
    far = 1.2 * float(np.linalg.norm(high - low))
    objects = SceneCfg(cube=False, look_at=tuple((low + high) / 2), view_distance=far, table_center=tuple((low + high)[:2] / 2))
    model = scene.build(robot, objects, SimCfg())
    qpos = model.qpos0.copy()
    qpos[[model.joint(j).qposadr[0] for j in robot.joints]] = robot.home
    with render.Renderer(model, width, height) as renderer:
        return renderer.draw(qpos, np.array([0.0, 0.0, -1.0]))  # the goal marker: under the table


def tables(report: Report) -> list[Table]:
    """The report for people."""
    joints = _table(f"joints of {report.robot}", "joint", "range", "home", "stiffness", "damping", "effort", "speed", "")
    for j in report.joints:
        gains = (j.home, j.stiffness, j.damping, j.effort, j.speed)
        note = f"{j.kind}, follows {j.follows}" if j.follows and j.home is None else j.kind
        joints.add_row(j.name, _range(j.range), *map(_number, gains), f"{note}, {j.group}" if j.group == "gripper" else note)
    joints.caption = "rad, N m/rad, N m s/rad, N m, rad/s; slides: m, N/m, N s/m, N, m/s"
    out = [joints]
    if report.open:
        names = [j.name for j in report.joints if j.group == "gripper"]
        gripper = _table("gripper", "", *names, "gap [mm]")
        ends = zip(("open", "closed"), (report.open, report.close), report.gaps or (None, None), strict=True)
        for name, values, gap in ends:
            gripper.add_row(name, *map(_number, values), "unknown" if gap is None else f"{1e3 * gap:.1f}")
        out.append(gripper)
    drives = _table("actuators: position drives", "actuator", "joint", "target", "force")
    for a in report.actuators:
        drives.add_row(a.name, a.joint, _range(a.target), _range(a.force))
    sites = _table("sites at home [m]", "site", "x", "y", "z")
    for name, position in report.sites.items():
        sites.add_row(name, *(_fixed(x, 3) for x in position))
    masses = _table("masses [kg]", "body", "mass")
    for name, mass in report.masses.items():
        masses.add_row(name, f"{mass:.4g}")
    masses.add_row("together", f"{sum(report.masses.values()):.4g}")
    masses.caption = f"gravity is {'' if report.gravity_compensation else 'not '}compensated"
    return [*out, drives, sites, masses, *_contact_tables(report), *(_task_tables(report.task) if report.task else [])]


def move_table(moved: Sequence[Move]) -> Table:
    """A line a movement."""
    view = _table("movements at the drives' speed limits, without contacts", "joint", "from", "to", "error", "time [s]")
    for name in ("fastest", "saturated [%]"):
        view.add_column(name, justify="right")
    for m in moved:
        there = "not there" if m.time is None else f"{m.time:.2f}"
        ends, error = (_fixed(m.start, 3), _fixed(m.target, 3)), _fixed(abs(m.end - m.target), 4)
        view.add_row(m.joint, *ends, error, there, f"{m.fastest:.2f}", f"{100 * m.saturation:.0f}")
    view.caption = "there: within 1% of the joint's range; rad, rad/s; slides: m, m/s"
    return view


def environment_table(rows: Sequence[Environment]) -> Table:
    """A line an environment."""
    view = _table("environments", "name", "task", "robot", "presets", "actions", "observations", "policy")
    for row in rows:
        sizes = ", ".join(f"{group} {size}" for group, size in row.observation_sizes.items())
        action = "" if row.action_size is None else str(row.action_size)
        ships = "ships" if row.policy else ""
        view.add_row(row.name, row.task, row.robot or "any (--robot)", ", ".join(row.presets), action, sizes, ships)
    for column in view.columns:
        column.justify = "left"
    return view


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


def _condim(model: mujoco.MjModel, a: int, b: int) -> int:
    """The higher priority's, else the larger."""
    (pa, pb), (da, db) = model.geom_priority[[a, b]], model.geom_condim[[a, b]]
    return int(max(da, db) if pa == pb else da if pa > pb else db)


def _pair(model: mujoco.MjModel, a: int, b: int, condim: int, elliptic: bool) -> Pair:
    a, b = sorted((a, b), key=lambda g: int(model.geom_type[g]))  # plane, height field, sphere, capsule, ..., as _MOST has them
    kinds = [mujoco.mjtGeom(model.geom_type[g]).name.removeprefix("mjGEOM_").lower() for g in (a, b)]
    contacts = _MOST.get(kinds[0], {}).get(kinds[1], _CONVEX)
    each = condim if elliptic else max(1, 2 * (condim - 1))
    return Pair(_geom(model, a), _geom(model, b), ", ".join(kinds), contacts, condim, contacts * each)


def _geom(model: mujoco.MjModel, geom: int) -> str:
    return model.geom(geom).name or f"{model.body(model.geom_bodyid[geom]).name}'s geom {geom}"


def _move(
    model: mujoco.MjModel, robot: RobotCfg, sim: SimCfg, start: np.ndarray, target: np.ndarray, moving: list[int]
) -> list[Move]:
    data, dt = mujoco.MjData(model), sim.dt * sim.decimation
    at, dof = ([int(getattr(model.joint(j), kind)[0]) for j in robot.joints] for kind in ("qposadr", "dofadr"))
    data.qpos[at], data.ctrl[:] = robot.home, start
    mujoco.mj_step(model, data, round(_REST / sim.dt))
    speed = np.array(robot.arm.speed + robot.gripper.speed)
    seconds = float(np.max(np.abs(target - start)[moving] / speed[moving])) + _AFTER
    begin, path, speeds, full = data.qpos[at].copy(), [], [], []
    limit = np.array(robot.arm.effort + robot.gripper.effort) * (1 - 1e-6)
    for _ in range(round(seconds / dt)):
        data.ctrl[:] += np.clip(target - data.ctrl, -speed * dt, speed * dt)
        for _ in range(sim.decimation):
            mujoco.mj_step(model, data)
            path.append(data.qpos[at].copy())
            speeds.append(np.abs(data.qvel[dof]))
            full.append(np.abs(data.actuator_force) >= limit)
    positions, out = np.array(path), []
    for i in moving:
        width = float(np.ptp(model.joint(robot.joints[i]).range)) or abs(target[i] - start[i])
        away = np.flatnonzero(~(np.abs(positions[:, i] - target[i]) <= _NEAR * width))
        steps = away[-1] + 1 if len(away) else 0
        out.append(
            Move(
                robot.joints[i],
                float(begin[i]),
                float(target[i]),
                float(positions[-1, i]),
                float((steps + 1) * sim.dt) if steps < len(positions) else None,
                float(np.max(speeds, axis=0)[i]),
                float(np.mean(full, axis=0)[i]),
            )
        )
    return out


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


def _contact_tables(report: Report) -> list[Table]:
    pairs = _table("geoms that can meet", "geom", "geom", "shapes", "contacts", "condim", "rows")
    for p in report.pairs:
        pairs.add_row(p.first, p.second, p.shapes, str(p.contacts), str(p.condim), str(p.rows))
    budget = _table("one environment at worst", "", "needed", "buffer (MJX-Warp)")
    shared = f"{report.contacts_per_env} on average: environments share it"
    budget.add_row("contacts", str(report.contacts), shared)
    budget.add_row("constraint rows", str(sum(report.rows.values())), str(report.constraints_per_env))
    for name, rows in report.rows.items():
        budget.add_row(f"  {name}", str(rows), "")
    return [pairs, budget]


def _task_tables(task: Task) -> list[Table]:
    head = _table(f"task of {task.env}, preset {task.preset}", "", "")
    head.show_header = False
    head.add_row("episode", f"{task.episode_s:g} s in steps of {task.control_dt:.4g} s")
    head.add_row(f"actions ({task.action_size})", task.action)
    head.add_row("command", task.command)
    for what, terms in (("termination", task.terminations), ("event", task.events)):
        for name, text in terms.items():
            head.add_row(f"{what} {name}", text)
    head.columns[1].justify = "left"
    rewards = _table("rewards, per second", "term", "weight")
    for name, weight in task.rewards.items():
        rewards.add_row(name, f"{weight:g}")
    out = [head, rewards]
    for group, sizes in task.observations.items():
        view = _table(f"observations: {group}", "term", "size")
        for name, size in sizes.items():
            view.add_row(name, str(size))
        view.add_row("together", str(sum(sizes.values())))
        out.append(view)
    return out


def _table(title: str, *columns: str) -> Table:
    """Names to the left, all else to the right."""
    view = Table(title=title.replace("[", r"\["), box=box.SIMPLE_HEAD, title_justify="left", caption_justify="left")
    view.collapse_padding, view.pad_edge = True, False
    for i, name in enumerate(columns):
        words = name in ("joint", "geom", "shapes") or not i
        # On a narrow terminal names stay whole and the rest wraps.
        view.add_column(name.replace("[", r"\["), justify="left" if words else "right", no_wrap=not i, overflow="fold")
    return view


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.5g}"


def _fixed(value: float, digits: int) -> str:
    return f"{round(value, digits) + 0.0:.{digits}f}"  # + 0.0: no "-0.000"


def _range(pair: Range | None) -> str:
    return "unlimited" if pair is None else f"{pair[0]:.5g} .. {pair[1]:.5g}"


def main(argv: Sequence[str]) -> None:
    """The command line of ``inspect``."""
    parser = cli.Parser(prog="python -m mjx_nero inspect", description="Shows what a robot or an environment is made of.")
    parser.add_argument("name", help="robot, environment, or folder of an imported robot")
    parser.add_argument("--preset", help="of the environment (default: its first)")
    parser.add_argument("--robot", help="for the environment: name, or folder of an imported robot")
    parser.add_argument("--move", action="store_true", help="move every joint to its limits and the gripper open and closed")
    parser.add_argument("--render", type=pathlib.Path, metavar="FILE", help="PNG of the robot at home")
    parser.add_argument("--json", type=pathlib.Path, metavar="FILE", help="everything, for programs")
    args, _ = parser.parse(argv)
    for path in filter(None, (args.render, args.json)):
        run_folder.check_writable(path)
    if args.render and args.render.suffix.lower() != ".png":
        raise UserError(f"{args.render} is no PNG: give a name that ends in .png")
    robot, cfg = find(args.name, args.preset, args.robot)
    report, console = inspect(args.name, args.preset, args.robot), cli.console()
    for view in tables(report):
        console.print(view)
    moved = moves(robot, cfg.sim if cfg else SimCfg()) if args.move else ()
    if moved:
        console.print(move_table(moved))
    if args.render:
        picture = draw(robot, cfg)
        with run_folder.whole(args.render) as part:
            imageio.imwrite(part, picture)
        console.print(f"picture: {args.render}", highlight=False, soft_wrap=True)
    if args.json:
        content: dict[str, Any] = {**dataclasses.asdict(report), "moves": [dataclasses.asdict(m) for m in moved]}
        with run_folder.whole(args.json) as part:
            part.write_text(json.dumps(content, indent=2) + "\n")
        console.print(f"json: {args.json}", highlight=False, soft_wrap=True)


def list_envs_main(argv: Sequence[str]) -> None:
    """The command line of ``list-envs``."""
    cli.Parser(prog="python -m mjx_nero list-envs", description="Lists the environments.").parse(argv)
    cli.console().print(environment_table(environments()))
