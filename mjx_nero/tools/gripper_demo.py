"""The gripper opens and closes by small steps: python -m mjx_nero gripper-demo --env cobotta_pick_place --out gripper.png

In MuJoCo's C library, the arm at home. Every control step asks for the measured positions plus or minus a constant, so that the
command keeps a constant lead until the joints' ranges end it. Nothing limits the drives' speed but their damping.
"""

import dataclasses
import math
import pathlib
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_nero import cli, console, files
from mjx_nero.control.gripper import ParallelGripper
from mjx_nero.envs import registry
from mjx_nero.envs.env import ManipulationEnv
from mjx_nero.errors import UserError
from mjx_nero.sim import kinematics, render, scene
from mjx_nero.sim.physics.native import NativePhysics

_SHARE = 0.08  # default step, of a joint's range: 0.1 rad for the RG6, as in Isaac Sim's tutorial
_ARRIVED = 1e-3  # [m]: a gap this close to where it ends counts as there


@dataclasses.dataclass(frozen=True)
class Motion:
    """What the gripper did, control step by control step; movements alternate, the first one closes.

    Attributes:
        time: [n] at the end of the step [s].
        movement: [n] number of the movement, from 0; even ones close.
        commanded: [n] gap between the pads that was asked for [m].
        measured: [n] gap at the end of the step [m].
        qpos: [n, nq].
        start: gap before the first step [m].
    """

    time: np.ndarray
    movement: np.ndarray
    commanded: np.ndarray
    measured: np.ndarray
    qpos: np.ndarray
    start: float


def demo(env: ManipulationEnv, cycles: int = 2, delta: float | None = None, seconds: float = 1.5) -> Motion:
    """Closes and opens the gripper ``cycles`` times.

    Args:
        env: its robot, scene and time step.
        delta: how far the command leads the measured positions [rad or m]; None: 8% of each joint's range.
        seconds: of one movement.

    Raises:
        UserError: ``delta`` or ``seconds`` is not above 0.
    """
    for name, value in (("delta", delta), ("seconds", seconds)):
        if value is not None and not 0 < value < math.inf:
            raise UserError(f"{name} takes a number above 0, got {value:g}")
    robot, model = env.cfg.robot, env.physics_model
    gripper, physics = ParallelGripper(robot), jax.jit(NativePhysics(model, env.cfg.sim).step)
    at = np.array([model.joint(j).qposadr[0] for j in gripper.joints])
    width = np.array([np.ptp(model.joint(j).range) for j in gripper.joints])
    closes = np.sign(gripper.closed - gripper.opened) * (_SHARE * width if delta is None else delta)
    step, gap = jax.jit(gripper.step), jax.jit(jax.vmap(gripper.gap))

    sim, _ = jax.jit(env.sample)(jax.random.PRNGKey(0))
    start = float(gap(sim.qpos[None, at])[0])
    movement = np.repeat(np.arange(2 * cycles), max(1, round(seconds / env.dt)))
    targets, qpos = [], []
    for m in movement:
        targets.append(step(sim.qpos[at], closes if m % 2 == 0 else -closes))
        sim, _ = physics(sim, jnp.concatenate([jnp.array(robot.arm.home), targets[-1]]))
        qpos.append(np.asarray(sim.qpos))
    commanded, measured = (np.asarray(gap(jnp.stack(list(q)))) for q in (targets, [q[at] for q in qpos]))
    return Motion(env.dt * np.arange(1, len(movement) + 1), movement, commanded, measured, np.stack(qpos), start)


def table(motion: Motion) -> console.Table:
    """A line a movement."""
    view = console.Table("gap between the pads [mm]", ("movement", "from", "to", "off the command", "time [s]"))
    begin, start = 0.0, motion.start
    for m in range(motion.movement[-1] + 1):
        part = motion.movement == m
        measured, end = motion.measured[part], motion.commanded[part][-1]
        there = np.flatnonzero(np.abs(measured - end) < _ARRIVED)
        arrived = f"{motion.time[part][there[0]] - begin:.2f}" if len(there) else "not there"
        gaps = (f"{1e3 * x:.2f}" for x in (start, measured[-1], abs(measured[-1] - end)))
        view.add("opens" if m % 2 else "closes", *gaps, arrived)
        begin, start = motion.time[part][-1], measured[-1]
    return view


def plot(motion: Motion, axes) -> None:
    """Commanded and measured gap over time, on matplotlib axes."""
    axes.plot(motion.time, 1e3 * motion.commanded, label="commanded", color="tab:gray", drawstyle="steps-pre")
    axes.plot(motion.time, 1e3 * motion.measured, label="measured", color="tab:blue")
    axes.set(xlabel="time [s]", ylabel="gap between the pads [mm]")
    axes.grid(alpha=0.3)
    axes.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=2, fontsize=8)


def close_up(env: ManipulationEnv) -> mujoco.MjModel:
    """The scene with its cameras on the gripper at home."""
    cfg, arm = env.cfg, env.cfg.robot.arm
    (ee,), _ = kinematics.Chain(env.physics_model, arm.joints, [cfg.robot.ee_site]).poses(jnp.array(arm.home))
    x, y, z = (float(v) for v in ee)
    return scene.build(cfg.robot, dataclasses.replace(cfg.scene, look_at=(x, y, z + 0.05), view_distance=0.7), cfg.sim)


def _save_plot(motion: Motion, title: str, path: pathlib.Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 3.6), layout="constrained")
    axes = figure.subplots()
    plot(motion, axes)
    axes.set_title(title, loc="left")
    with files.whole(path) as part:
        figure.savefig(part, dpi=110)


def main(argv: Sequence[str]) -> None:
    """The command line."""
    parser = cli.Parser(prog=cli.called_as("gripper-demo"), description="Opens and closes a gripper, and plots its gap.")
    parser.add_environment(registry.list_envs(), "cobotta_pick_place")
    parser.add_argument("--cycles", type=cli.positive, default=2, help="times to close and open (default: %(default)s)")
    parser.add_argument(
        "--delta",
        type=cli.positive_float,
        help="how far the command leads the measured positions, rad or m (default: 8%% of the joints' range)",
    )
    parser.add_argument("--seconds", type=cli.positive_float, default=1.5, help="of one movement (default: %(default)s)")
    parser.add_argument(
        "--out",
        type=cli.path(".png", ".pdf", ".svg"),
        default=pathlib.Path("gripper.png"),
        help="the plot (default: %(default)s)",
    )
    parser.add_argument("--video", type=cli.path(".mp4"), help="MP4 of the gripper")
    args, _ = parser.parse(argv)
    for path in filter(None, (args.out, args.video)):
        files.check_writable(path)
    cli.setup_jax()
    env = registry.make(args.env, args.preset, impl="native", robot=args.robot)
    motion = demo(env, args.cycles, args.delta, args.seconds)
    screen = console.screen()
    screen.print(table(motion))
    _save_plot(motion, f"gripper of {env.cfg.robot.name}", args.out)
    console.wrote(screen, "plot", args.out)
    if args.video:
        scenery = render.unmarked(len(motion.qpos), 1)
        render.write_episodes(args.video, close_up(env), motion.qpos[:, None], scenery, env.dt)
        console.wrote(screen, "video", args.video)
