"""Gains for a robot's drives from its own model: python -m mjx_nero tune-gains --robot nero --out gains.yaml --plot gains.png

In MuJoCo's C library, without contacts and without a limit on the targets' speed: the drives themselves are seen.

How the gains are chosen, for each drive:

- Inertia: the diagonal of the joint-space inertia matrix (armature included) over random poses within the joint limits. That is
  what a joint turns while the drives of the others hold theirs. The inverse of the inverse's diagonal, what it turns while the
  others swing freely, is smaller, so damping for the former never turns out too little. Of the poses the 95th percentile counts.
- Stiffness: the largest that both allow. A step of the target by ``step`` asks for less than the effort that the largest gravity
  load leaves, and the natural frequency stays below one radian a control step: a faster drive would follow every stair of targets
  that change only so often. (A drive at its limit does not damp, and a light joint then jumps within one physics step.)
- Damping: a damping ratio of 0.8 (1.5% overshoot) at that inertia, so critical at 64% of it and more than critical below: no
  pose overshoots by much, and the light ones are not slowed for the sake of the heaviest. On top comes stiffness x step: the
  integrator (implicitfast) takes a drive's spring force from the beginning of a physics step and its damping from the end, and
  that recursion has its double real pole at d = 2 sqrt(k I) + k dt.

At home and in random poses no joint of the package's own arms then overshoots by 2%, nor meets its effort limit.

A gripper's stiffness also sets how hard it grips at a given target: look at that before taking its gains over.
"""

import argparse
import dataclasses
import math
import pathlib
from collections.abc import Sequence

import mujoco
import numpy as np
import yaml
from rich import box
from rich.table import Table

from mjx_nero import cli, registry, run_folder, scene
from mjx_nero.robots import RobotCfg
from mjx_nero.scene import SceneCfg, SimCfg
from mjx_nero.types import UserError

_RATIO = 0.8  # damping ratio at the heaviest pose that counts
_RESERVE = 0.99  # of the effort, for the step: the limit itself is never met
_POSES = 500
_SECONDS = 5.0  # of a response: several time constants of the slowest drive in the package
_SHARE = 0.1  # a step is at most this share of the joint's range: 5 mm on a finger's slide of 50 mm
_BAND = 0.02  # settled: within this share of the way


@dataclasses.dataclass(frozen=True)
class Response:
    """A joint's answer to a step of its drive's target.

    Attributes:
        joint: its name.
        step: by which the target moved [rad or m].
        time: [n] since the step, from 0 [s].
        position: [n] way since the step [rad or m].
        force: [n - 1] of the drive, during each physics step [N m or N].
        error: what lacks to the target at the end [rad or m]; gravity's sag included.
        effort: the drive's limit [N m or N].
    """

    joint: str
    step: float
    time: np.ndarray
    position: np.ndarray
    force: np.ndarray
    error: float
    effort: float

    @property
    def share(self) -> np.ndarray:
        """[n] of the way to where the joint comes to rest; NaN where it does not move."""
        end = self.position[-1]
        return self.position / end if abs(end) > 1e-6 * abs(self.step) else np.full_like(self.position, np.nan)

    @property
    def rise(self) -> float:
        """From 10% to 90% of the way [s]."""
        return self._first(0.9) - self._first(0.1)

    @property
    def overshoot(self) -> float:
        """Beyond the end, as a share of the way."""
        return float(np.max(self.share)) - 1.0

    @property
    def settling(self) -> float:
        """Until within 2% of the way for good [s]; inf if the joint still moves at the end."""
        share = self.share
        outside = np.flatnonzero(~(np.abs(share - 1) <= _BAND))
        last = outside[-1] if len(outside) else -1
        return float(self.time[last + 1]) if last < 0.9 * len(share) else math.inf

    @property
    def saturation(self) -> float:
        """Share of the time until settled that the drive pushes with all its effort."""
        full = np.abs(self.force) >= self.effort * (1 - 1e-6)
        return float(np.mean(full[self.time[1:] <= max(self.settling, self.time[1])]))

    def _first(self, level: float) -> float:
        share = self.share
        above = np.flatnonzero(share >= level)
        if not len(above):
            return math.nan
        k = above[0]
        return float(np.interp(level, share[k - 1 : k + 1], self.time[k - 1 : k + 1]))


@dataclasses.dataclass(frozen=True)
class Load:
    """What a drive has to move over the workspace.

    Attributes:
        joint: its name.
        light, heavy: 5th and 95th percentile of the inertia [kg m^2 or kg].
        gravity: largest static load [N m or N].
        effort: the drive's limit [N m or N].
        friction: damping that the joint has of its own [N m s/rad or N s/m].
    """

    joint: str
    light: float
    heavy: float
    gravity: float
    effort: float
    friction: float


@dataclasses.dataclass(frozen=True)
class Tuning:
    """Gains and responses before and after; tuples run along the robot's joints.

    Attributes:
        robot, tuned: the robot with its gains, and with the proposed ones.
        loads: what the drives have to move.
        before, after: step responses at home.
    """

    robot: RobotCfg
    tuned: RobotCfg
    loads: tuple[Load, ...]
    before: tuple[Response, ...]
    after: tuple[Response, ...]


def tune(robot: RobotCfg, step: float = 0.1, frequency: float | None = None, sim: SimCfg | None = None) -> Tuning:
    """Proposes gains for all drives of a robot, and measures its step responses with both.

    Args:
        step: of the target, that the drives answer within their effort [rad or m]; at most a tenth of a joint's range.
        frequency: bound of the natural frequency [Hz]; None: one radian a control step.
        sim: physics and control step.

    Raises:
        UserError: a number is out of range, the frequency too high for the physics step, or gravity overpowers a drive.
    """
    sim = sim or SimCfg()
    for name, value in (("step", step), ("frequency", frequency)):
        if value is not None and not 0 < value < math.inf:
            raise UserError(f"{name} takes a number above 0, got {value:g}")
    if not 1e-4 <= sim.dt <= 0.1:
        raise UserError(f"dt takes a physics step from 0.0001 to 0.1 s, got {sim.dt:g}")
    frequency = 1 / (2 * math.pi * sim.dt * sim.decimation) if frequency is None else frequency
    if 2 * math.pi * frequency * sim.dt > 1:
        limit = 1 / (2 * math.pi * sim.dt)
        raise UserError(f"a physics step of {sim.dt:g} s cannot follow {frequency:g} Hz: at most {limit:.3g} Hz")
    model = drives_model(robot, sim)
    carried = loads(model)
    sizes = np.abs(steps(model, robot.home, step))
    gains = [propose(load, size, frequency, sim.dt) for load, size in zip(carried, sizes, strict=True)]
    stiffness, damping = zip(*gains, strict=True)
    n = len(robot.arm.joints)
    tuned = dataclasses.replace(
        robot,
        arm=dataclasses.replace(robot.arm, stiffness=stiffness[:n], damping=damping[:n]),
        gripper=dataclasses.replace(robot.gripper, stiffness=stiffness[n:], damping=damping[n:]),
    )
    before, after = (respond(m, robot.home, step) for m in (model, drives_model(tuned, sim)))
    return Tuning(robot, tuned, carried, before, after)


def drives_model(robot: RobotCfg, sim: SimCfg) -> mujoco.MjModel:
    """The robot with its drives, without contacts. Where gains make it diverge, its state turns NaN instead of starting anew."""
    model = scene.build(robot, SceneCfg(cube=False), sim, visuals=False)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_AUTORESET
    return model


def propose(load: Load, step: float, frequency: float, dt: float) -> tuple[float, float]:
    """(stiffness [N m/rad or N/m], damping [N m s/rad or N s/m]); the module says why.

    Args:
        step: of the target, that the drive answers within its effort [rad or m].
        frequency: bound of the natural frequency [Hz].
        dt: physics step [s].

    Raises:
        UserError: gravity leaves the drive no effort.
    """
    spare = load.effort - load.gravity
    if spare <= 0:
        raise UserError(
            f"{load.joint}: gravity asks up to {load.gravity:.3g} of a drive limited to {load.effort:.3g}: "
            "raise its effort, or let the robot compensate gravity"
        )
    critical = _RATIO**2 * load.heavy  # the inertia that is damped critically
    stiffness = _round(min(_RESERVE * spare / step, (2 * math.pi * frequency) ** 2 * critical), math.floor)
    return stiffness, _round(max(2 * math.sqrt(stiffness * critical) + stiffness * dt - load.friction, 0.0), math.ceil)


def loads(model: mujoco.MjModel, poses: int = _POSES, seed: int = 0) -> tuple[Load, ...]:
    """What each drive of a model has to move, over random poses within the joint limits.

    Joints that equalities couple move as one: their drives share its inertia and load.
    """
    data, (joints, dofs), moves = mujoco.MjData(model), _driven(model), _moves(model)
    leader, ratio = _leaders(model)
    together = leader[:, None] == leader
    # With equal gains a drive takes ratio / sum(ratio^2) of a force and 1 / sum(ratio^2) of an inertia of the common motion.
    squares = np.where(together, ratio**2, 0).sum(axis=1)
    lower, upper = _ranges(model)[joints].T
    rng, full = np.random.default_rng(seed), np.zeros((model.nv, model.nv))
    inertia, gravity = np.zeros((2, poses, model.nu))
    for k in range(poses):
        _pose(model, data, rng.uniform(lower, upper))
        mujoco.mj_fullM(model, data, full)
        inertia[k] = np.einsum("ac,ab,bc->c", moves, full, moves)[leader] / squares
        gravity[k] = np.abs((data.qfrc_bias - data.qfrc_gravcomp) @ moves)[leader] * np.abs(ratio) / squares
    light, heavy = np.percentile(inertia, [5, 95], axis=0)
    efforts = np.where(model.actuator_forcelimited, model.actuator_forcerange[:, 1], np.inf)
    columns = (light, heavy, gravity.max(axis=0), efforts, model.dof_damping[dofs])
    return tuple(Load(model.joint(j).name, *map(float, row)) for j, *row in zip(joints, *columns, strict=True))


def steps(model: mujoco.MjModel, pose: Sequence[float], step: float) -> np.ndarray:
    """[nu] steps of the drives' targets: ``step``, at most a tenth of the joint's range, away from its nearer end."""
    (joints, _), (leader, ratio), at = _driven(model), _leaders(model), np.asarray(pose)
    lower, upper = _ranges(model)[joints].T
    size = np.minimum(step, _SHARE * (upper - lower)) * np.where(at - lower > upper - at, -1, 1)
    first = np.array([np.flatnonzero(leader == c)[0] for c in leader])  # coupled joints step together
    return size[first] * ratio / ratio[first]


def respond(model: mujoco.MjModel, pose: Sequence[float], step: float, seconds: float = _SECONDS) -> tuple[Response, ...]:
    """Step responses of all drives of a model, one after another; the others hold ``pose``. Coupled joints step together.

    Args:
        model: with position drives on joints.
        pose: [nu], where the drives hold the joints before the step [rad or m].
        step: see ``steps``.
    """
    data, (joints, _) = mujoco.MjData(model), _driven(model)
    at = model.jnt_qposadr[joints]
    held, change, (leader, _) = np.asarray(pose, float), steps(model, pose, step), _leaders(model)
    _pose(model, data, held)
    n = max(2, round(seconds / model.opt.timestep))
    for _ in range(n):  # gravity sags the joints
        mujoco.mj_step(model, data)
    rest = data.qpos.copy(), data.qvel.copy(), data.qacc_warmstart.copy()
    out: dict[int, Response] = {}
    efforts = np.where(model.actuator_forcelimited, model.actuator_forcerange[:, 1], np.inf)
    for c in np.unique(leader):
        data.qpos[:], data.qvel[:], data.qacc_warmstart[:] = rest
        data.ctrl[:] = held + np.where(leader == c, change, 0)
        path, force = [data.qpos[at].copy()], []
        for _ in range(n):
            mujoco.mj_step(model, data)
            path.append(data.qpos[at].copy())
            force.append(data.actuator_force.copy())
        positions, forces = np.array(path), np.array(force)
        for i in map(int, np.flatnonzero(leader == c)):
            out[i] = Response(
                joint=model.joint(joints[i]).name,
                step=float(change[i]),
                time=model.opt.timestep * np.arange(n + 1),
                position=positions[:, i] - positions[0, i],
                force=forces[:, i],
                error=float(data.ctrl[i] - positions[-1, i]),
                effort=float(efforts[i]),
            )
    return tuple(out[i] for i in range(model.nu))


def _driven(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """Joints and degrees of freedom that the drives act on, [nu] each."""
    joints = model.actuator_trnid[:, 0]
    return joints, model.jnt_dofadr[joints]


def _ranges(model: mujoco.MjModel) -> np.ndarray:
    """[njnt, 2]; half a turn to either side where there is no limit."""
    return np.where(model.jnt_limited[:, None].astype(bool), model.jnt_range, [-math.pi, math.pi])


def _couplings(model: mujoco.MjModel) -> list[tuple[int, int, np.ndarray]]:
    """(follower, leader, polynomial) of joints that an equality couples, leaders before their followers' followers."""
    joint = np.flatnonzero((model.eq_type == mujoco.mjtEq.mjEQ_JOINT) & (model.eq_obj2id >= 0) & model.eq_active0.astype(bool))
    pairs = [(int(model.eq_obj1id[e]), int(model.eq_obj2id[e]), model.eq_data[e, :5]) for e in joint]
    followers = {follower: leader for follower, leader, _ in pairs}

    def depth(joint: int) -> int:
        seen = [joint]
        while seen[-1] in followers and followers[seen[-1]] not in seen:
            seen.append(followers[seen[-1]])
        return len(seen)

    return sorted(pairs, key=lambda pair: depth(pair[0]))


def _moves(model: mujoco.MjModel) -> np.ndarray:
    """[nv, nv] column c: how all joints move when joint c does and its followers follow, in a linkage at its zero."""
    moves = np.eye(model.nv)
    for follower, leader, coefficients in _couplings(model):
        moves[model.jnt_dofadr[follower]] = coefficients[1] * moves[model.jnt_dofadr[leader]]
    return moves


def _leaders(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """For each drive the degree of freedom that moves its joint, itself or the one that leads it, and the ratio; [nu] each."""
    rows = _moves(model)[_driven(model)[1]]
    leader = np.abs(rows).argmax(axis=1)
    return leader, np.take_along_axis(rows, leader[:, None], axis=1)[:, 0]


def _pose(model: mujoco.MjModel, data: mujoco.MjData, pose: np.ndarray) -> None:
    """Puts the driven joints and the drives' targets at ``pose``, coupled joints where their leaders have them."""
    at, zero = model.jnt_qposadr, model.qpos0
    mujoco.mj_resetData(model, data)
    data.qpos[at[_driven(model)[0]]], data.ctrl[:] = pose, pose
    for follower, leader, coefficients in _couplings(model):
        way = data.qpos[at[leader]] - zero[at[leader]]
        data.qpos[at[follower]] = zero[at[follower]] + np.polynomial.polynomial.polyval(way, coefficients)
    mujoco.mj_forward(model, data)


def _round(value: float, way) -> float:
    """To three significant digits: stiffness down, to stay within the effort; damping up, to stay without overshoot."""
    if value == 0:
        return 0.0
    unit = 10.0 ** (math.floor(math.log10(value)) - 2)
    return float(f"{way(value / unit + (1e-9 if way is math.floor else -1e-9)) * unit:.3g}")


def gains(robot: RobotCfg) -> dict[str, dict[str, float]]:
    """Joint -> stiffness, damping, effort and speed, to three significant digits: what ``import-urdf --gains`` takes."""
    out = {}
    for drive in (robot.arm, robot.gripper):
        for i, joint in enumerate(drive.joints):
            fields = {name: getattr(drive, name)[i] for name in ("stiffness", "damping", "effort", "speed")}
            out[joint] = {name: float(f"{value:.3g}") for name, value in fields.items()}
    return out


def table(tuning: Tuning) -> tuple[Table, Table]:
    """The gains, and the step responses; before -> after."""
    chosen = _table(
        f"gains of {tuning.robot.name}", "inertia [kg m2, kg]", "gravity", "effort", "stiffness", "damping", "sag [mrad, mm]"
    )
    seen = _table(
        "step responses at home", "step [mrad, mm]", "rise [s]", "overshoot [%]", "settled [s]", "error", "saturated [%]"
    )
    old, new = gains(tuning.robot), gains(tuning.tuned)
    for load, before, after in zip(tuning.loads, tuning.before, tuning.after, strict=True):
        a, b = old[load.joint], new[load.joint]
        sag_a, sag_b = (1e3 * load.gravity / x["stiffness"] if x["stiffness"] else math.inf for x in (a, b))
        chosen.add_row(
            load.joint,
            f"{load.light:.3g} .. {load.heavy:.3g}",
            f"{load.gravity:.2f}",
            f"{load.effort:g}",
            _change(a["stiffness"], b["stiffness"], "{:g}"),
            _change(a["damping"], b["damping"], "{:g}"),
            _change(sag_a, sag_b, "{:.1f}"),
        )
        seen.add_row(
            load.joint,
            f"{1e3 * before.step:.3g}",
            _change(before.rise, after.rise, "{:.2f}"),
            _change(1e2 * before.overshoot, 1e2 * after.overshoot, "{:.1f}"),
            _change(before.settling, after.settling, "{:.2f}"),
            _change(1e3 * before.error, 1e3 * after.error, "{:.1f}"),
            _change(1e2 * before.saturation, 1e2 * after.saturation, "{:.0f}"),
        )
    return chosen, seen


def _table(title: str, *columns: str) -> Table:
    view = Table(title=title, box=box.SIMPLE_HEAD, title_justify="left", collapse_padding=True, pad_edge=False)
    view.add_column("joint", no_wrap=True)
    for name in columns:
        view.add_column(name.replace("[", r"\["), justify="right", overflow="fold")  # rich takes a bare [word] for a style
    return view


def _change(before: float, after: float, form: str) -> str:
    texts = (form.format(x) if math.isfinite(x) else "never" for x in (before, after))
    return " -> ".join(text.lstrip("-") if not text.strip("-0.") else text for text in texts)  # no "-0.0"


def plot(tuning: Tuning, figure) -> None:
    """One panel a joint on a matplotlib figure: the way, as a share of the step, before and after."""
    n = len(tuning.before)
    columns = min(4, n)
    panels = figure.subplots(math.ceil(n / columns), columns, squeeze=False, sharey=True).ravel()
    for panel, before, after in zip(panels, tuning.before, tuning.after, strict=False):
        settled = [r.settling for r in (before, after) if math.isfinite(r.settling)]
        panel.axhline(1, color="black", linewidth=0.8, linestyle=":", label="target")
        for response, label, color in ((before, "before", "tab:gray"), (after, "after", "tab:blue")):
            panel.plot(response.time, response.position / response.step, label=label, color=color)
        panel.set_title(before.joint, loc="left", fontsize=9)
        panel.set_xlim(0, 1.3 * max(settled, default=_SECONDS))
        panel.grid(alpha=0.3)
    for panel in panels[n:]:
        panel.set_axis_off()
    panels[0].legend(fontsize=8, loc="lower right")
    figure.suptitle(f"step responses of {tuning.robot.name}, as a share of the step", x=0.01, ha="left")
    figure.supxlabel("time since the step [s]", fontsize=9)


def _save_plot(tuning: Tuning, path: pathlib.Path) -> None:
    from matplotlib.figure import Figure

    rows = math.ceil(len(tuning.before) / 4)
    figure = Figure(figsize=(11, 0.8 + 2.1 * rows), layout="constrained")
    plot(tuning, figure)
    with run_folder.whole(path) as part:
        figure.savefig(part, dpi=110)


def _save_gains(tuning: Tuning, path: pathlib.Path) -> None:
    units = "stiffness [N m/rad or N/m], damping [N m s/rad or N s/m], effort [N m or N], speed [rad/s or m/s]"
    with run_folder.whole(path) as part:
        part.write_text(f"# Drives of {tuning.robot.name}: {units}\n{yaml.safe_dump(gains(tuning.tuned), sort_keys=False)}")


def main(argv: Sequence[str]) -> None:
    """The command line."""
    parser = cli.Parser(
        prog="python -m mjx_nero tune-gains",
        description="Proposes stiffness and damping for a robot's drives, and shows the step responses before and after.",
    )
    parser.add_argument("--robot", required=True, help="name, or folder of an imported robot")
    parser.add_argument("--out", type=pathlib.Path, help="YAML of the gains, for import-urdf --gains")
    parser.add_argument("--plot", type=pathlib.Path, help="picture of the step responses")
    parser.add_argument(
        "--step",
        type=float,
        default=0.1,
        help="of the target, within the drives' effort, rad or m; at most a tenth of a joint's range (default: %(default)s)",
    )
    parser.add_argument("--frequency", type=float, help="bound of the natural frequency, Hz (default: one radian a control step)")
    parser.add_argument("--dt", type=float, default=SimCfg.dt, help="physics step, s (default: %(default)s)")
    parser.add_argument(
        "--gravity-compensation", action=argparse.BooleanOptionalAction, help="instead of the robot's own setting"
    )
    args, _ = parser.parse(argv)
    for path in filter(None, (args.out, args.plot)):
        run_folder.check_writable(path)
    robot = registry.robot(args.robot)
    if args.gravity_compensation is not None:
        robot = dataclasses.replace(robot, gravity_compensation=args.gravity_compensation)
    tuning = tune(robot, args.step, args.frequency, SimCfg(dt=args.dt))
    console = cli.console()
    console.print(*table(tuning))
    if args.plot:  # first, as matplotlib may not know the kind of file
        _save_plot(tuning, args.plot)
        console.print(f"plot: {args.plot}", highlight=False, soft_wrap=True)
    if args.out:
        _save_gains(tuning, args.out)
        console.print(f"gains: {args.out}", highlight=False, soft_wrap=True)


if __name__ == "__main__":
    cli.run(main)
