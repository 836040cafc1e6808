"""The checks: the gripper's limits, the home pose, and tries of a script that picks and places a cube."""

import time
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array

from mjx_nero import control
from mjx_nero.config import bounds
from mjx_nero.config.bounds import Range
from mjx_nero.control.ik import IkCfg, InverseKinematics
from mjx_nero.control.pick_place import PHASES, PickPlace, PickPlaceMemory
from mjx_nero.envs.task import EnvCfg
from mjx_nero.errors import UserError
from mjx_nero.mdp import rewards
from mjx_nero.mdp.actions import rate_limit
from mjx_nero.sim import scene, touch
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.sim.scene import SceneCfg, SimCfg
from mjx_nero.tasks import registry
from mjx_nero.tools import motion
from mjx_nero.tools.self_test.play import play
from mjx_nero.tools.self_test.result import Result
from mjx_nero.types import View

TRIES = 8
MOST_JOINTS = 16  # maximum joints of an arm, so that its inverse kinematics compiles within seconds
DEEP = 0.005  # [m] overlap that is ignored, because shapes may be wider than their links
FULL = 0.5  # share of a movement at the effort limit from which on that limit is why it ends early
SLOW = 0.5  # [s] a drive that lags more than this does not arrive in time
AWAY = 0.01  # [m] a hand farther from its place at the end of a phase has not arrived; a cube that moved more was pushed
LEFT = 5e-4  # [rad, m] what dry friction may leave of the fingers' way: 1% of a small hand's is less
EMPTY = 0.02  # share of the fingers' travel: fingers closer to closed hold nothing
REACHED = 0.01  # [m]
SETTLED, LONGEST = 3.0, 30.0  # [s] waiting time after the set-point has arrived; maximum time of a try
ANY_TURN, FREE = 4.0, 0.005  # [rad, m/rad] tolerance and weight of the hand's orientation, if only its position matters
# What was observed in tries that fail in a phase of the script, and what to look at then.
PUSHED = "the hand pushes the cube away before it closes: look at ee, down and opening"
SEEN = {
    "above pick": "the hand stays {away:.0f} mm from its place over the cube: look at pick and home",
    "down": "the hand stays {away:.0f} mm from the cube: look at pick and lean",
    "close": "the fingers close beside the cube: look at ee, grip and pad",
    "up": "the cube slips out of the hand: look at pad and at the gripper's effort",
    "across": "the cube is lost on its way: look at hold and at the gripper's effort",
    "place": "the cube does not stay where it belongs: look at pick, hold and opening",
}


def run(robot: RobotCfg, tries: int = TRIES) -> Result:
    """Tests a robot for some seconds, in MuJoCo's C library. JAX uses the CPU, for which it compiles faster."""
    begun = time.monotonic()
    with jax.default_device(jax.devices("cpu")[0]):
        tried = _tried(robot, tries)
    return Result(
        gripper=_gripper(robot),
        home=_home(robot),
        has_gripper=bool(robot.gripper.joints),
        seconds=round(time.monotonic() - begun, 1),
        **tried,
    )


def _gripper(robot: RobotCfg) -> str:
    """Says where the gripper stops before one of its limits, and why; empty if it does not."""
    lags = dict(zip(robot.gripper.joints, robot.gripper.lead, strict=True))
    sim = SimCfg().finer(robot.max_step)
    bounds.check(sim)
    for move in motion.gripper_moves(robot, sim):
        if move.time is not None or abs(move.end - move.target) < LEFT:
            continue
        why = "look at the range, the speed and the gains of its joint"
        if move.saturation > FULL:
            why = "its drive is at its effort limit: look at that limit, and at the joint's damping and friction"
        elif lags[move.joint] > SLOW:
            why = f"its drive lags by {lags[move.joint]:.2g} s, damping over stiffness: look at tune-gains"
        return f"the gripper stops at {move.end:.3g} of {move.target:.3g} (joint {move.joint!r}): {why}"
    return ""


def _home(robot: RobotCfg) -> str:
    """Says which parts touch in the home pose; empty if none do."""
    model = scene.build(robot, SceneCfg(objects={}), SimCfg(), visuals=False)
    data = mujoco.MjData(model)
    for joint, position in zip(robot.joints, robot.home, strict=True):
        data.joint(joint).qpos = position
    mujoco.mj_forward(model, data)
    geoms = {int(geom) for contact in data.contact if contact.dist < 0 for geom in contact.geom}
    links = {model.body(model.geom_bodyid[geom]).name for geom in geoms} - {"world"}
    found = [f"{link!r} touches the table" for link in sorted(links)]
    found += [f"{a!r} lies {1e3 * deep:.0f} mm within {b!r}" for (a, b), deep in touch.at_home(robot).items() if deep > DEEP]
    more = f" and {len(found) - 2} more" if len(found) > 2 else ""
    return f"at home {', '.join(found[:2])}{more}: look at home" if found else ""


def _tried(robot: RobotCfg, tries: int) -> dict[str, Any]:
    """Runs the tries; returns their fields of a result."""
    none = {"script": "", "tries": 0, "good": 0, "placed": 0, "failures": {}}
    if len(robot.arm.joints) > MOST_JOINTS:
        return {**none, "reason": f"no try: an arm of more than {MOST_JOINTS} joints"}
    reason = ""
    if robot.gripper.joints:
        try:
            return _grasps(registry.env_cfg("pick_place", robot=robot), tries)
        except UserError as error:
            reason = str(error)
    try:
        return _reaches(registry.env_cfg("follow_target", robot=robot), tries, reason)
    except UserError as error:
        return {**none, "reason": reason or str(error)}


class _Goer:
    """Moves straight to the inverse kinematics solution of the goal, with any orientation, at the drives' speed limits."""

    def __init__(self, robot: RobotCfg, dt: float):
        self._n, self._step = len(robot.arm.joints), np.array(robot.arm.speed, np.float32) * dt
        self._ik = InverseKinematics(robot, cfg=IkCfg(orientation_tolerance=ANY_TURN, orientation_weight=FREE))
        low, high = (np.clip(end, -np.pi, np.pi) for end in (self._ik.chain.lower, self._ik.chain.upper))
        self.seconds = min(SETTLED + float(np.max((high - low) / robot.arm.speed)), LONGEST)

    def init(self, view: View) -> tuple[Array, Array]:
        """Returns the set-point and its goal [rad or m]."""
        q = view.joint_pos[: self._n]
        return q, self._ik.solve(view.goal_pos_w, view.goal_quat_w, q, jax.random.PRNGKey(0)).q

    def step(self, memory: tuple[Array, Array], view: View) -> tuple[tuple[Array, Array], Array]:
        """Moves the targets of the arm's drives; the gripper's stay."""
        q, goal = memory
        q = rate_limit(goal, q, step=jnp.asarray(self._step))
        return (q, goal), jnp.concatenate([q, view.ctrl[self._n :]])

    def warning(self, memory: Any) -> str:
        """Returns no warning."""
        return ""


def _reaches(cfg: EnvCfg, tries: int, reason: str) -> dict[str, Any]:
    """Tries to reach points of the workspace, for an arm that cannot grasp."""
    robot, dt = cfg.robot, cfg.sim.dt * cfg.sim.decimation
    box = robot.workspace or robot.pick
    assert box is not None  # follow_target requires it
    goals, goer = _drawn(box, tries), _Goer(robot, dt)

    def watch(memory: Any, view: View) -> dict[str, Array]:
        return {"away": jnp.linalg.norm(view.ee_pos_w - view.goal_pos_w)}

    away = play(cfg, goer, round(goer.seconds / dt), {}, goals, watch)["away"][-1]
    good = int((away < REACHED).sum())
    if good < tries and not reason:
        reason = f"it stops up to {1e3 * np.nanmax(away):.0f} mm from the others: look at workspace and at the gains"
    return {"script": "reach", "tries": tries, "good": good, "placed": 0, "failures": {}, "reason": reason}


def _grasps(cfg: EnvCfg, tries: int) -> dict[str, Any]:
    """Tries to pick up the cube where the task puts it and to place it at the goal."""
    dt, lies, goal = cfg.sim.dt * cfg.sim.decimation, cfg.events["reset_object_position"].params, cfg.command.params
    places, goals = _drawn([lies[k] for k in "xy"], tries), _drawn([goal[k] for k in "xyz"], tries, seed=1)
    script = control.make("pick_place", cfg.robot, dt, cfg.controllers["pick_place"])
    assert isinstance(script, PickPlace)
    n, closed = len(cfg.robot.arm.joints), jnp.asarray(script.gripper.closed)
    way = jnp.maximum(jnp.abs(jnp.asarray(script.gripper.opened) - closed), 1e-6)

    def watch(memory: PickPlaceMemory, view: View) -> dict[str, Array]:
        return {
            "away": jnp.linalg.norm(view.ee_pos_w - memory.target[:3]),
            "cube": view.objects["cube"].pos_w,
            "apart": jnp.max(jnp.abs(view.joint_pos[n:] - closed) / way),
            "held": rewards.held(view, **cfg.metrics["grasped"].params),
            "placed": cfg.success.condition.func(view, **cfg.success.condition.params),
        }

    rest = round(cfg.success.hold_s / dt)
    seen = play(cfg, script, int(script.steps.sum()) + rest, {"cube": places}, goals, watch)
    held, placed = np.asarray(seen["held"].any(0)), np.asarray(seen["placed"][-rest:].all(0))
    failures: dict[str, list[str]] = {}
    for i in np.flatnonzero(~placed):
        phase, text = _failure({name: value[:, i] for name, value in seen.items()}, np.cumsum(script.steps) - 1, bool(held[i]))
        failures.setdefault(phase, []).append(text)
    most = max(failures.values(), key=len, default=[""])
    counts = {phase: len(texts) for phase, texts in failures.items()}
    done = {"tries": tries, "good": int(held.sum()), "placed": int(placed.sum())}
    return {"script": "pick_place", **done, "failures": counts, "reason": most[0]}


def _drawn(box: Sequence[Range], tries: int, seed: int = 0) -> np.ndarray:
    """Draws random points [tries, len(box)] in a box, always the same ones."""
    low, high = np.array(box).T
    return low + (high - low) * np.random.default_rng(seed).random((tries, len(box)))


def _failure(seen: dict[str, np.ndarray], ends: np.ndarray, grasped: bool) -> tuple[str, str]:
    """Returns the phase in which a try failed, and what was observed.

    Args:
        seen: what was watched, [steps, ...].
        ends: last step of each phase.
        grasped: whether the cube was held at any time.
    """
    away, cube = seen["away"], seen["cube"]
    if grasped:
        phase = "across" if not seen["held"][ends[PHASES.index("across")]] else "place"
        return phase, SEEN[phase]
    for phase, end in zip(("above pick", "down"), (ends[0], ends[2]), strict=True):
        if not away[end] < AWAY:
            return phase, SEEN[phase].format(away=1e3 * away[end])
    if not np.linalg.norm(cube[ends[2]] - cube[0]) < AWAY:
        return "down", PUSHED
    phase = "close" if seen["apart"][ends[3]] < EMPTY else "up"
    return phase, SEEN[phase]
