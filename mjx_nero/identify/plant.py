"""Model of an arm and its drives for identification: computes encoder readings from parameters and targets.

It uses MuJoCo's C library, without contacts. A target takes effect ``delay`` after it was sent, until the next does. The drive
pulls the joint to it, and the encoder reads the joint's position plus an offset:

    (M(q) + armature) qdd + c(q, qd) = stiffness (target - q) - damping qd - friction sign(qd),   reading = q + offset
"""

import copy
import dataclasses

import mujoco
import numpy as np
from jaxtyping import Float
from mujoco import rollout

from mjx_nero import cores
from mjx_nero.errors import UserError
from mjx_nero.sim import scene
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.sim.scene import SceneCfg, SimCfg

REST = 0.5  # time before a log, during which its first target holds the arm [s]
FRICTION = 0.01  # first guess of joint friction, as a share of the drive's effort, if the model has none
MAX_NUMBERS = 100_000_000  # maximum count of numbers in states and targets that are simulated at once
SHORTEST, USUAL = 1e-4, 0.005  # physics steps [s]
_PHASE = 0.25  # maximum phase of a drive's oscillation in one physics step [rad]
POSITIVE = ("stiffness", "damping", "armature", "friction")


@dataclasses.dataclass(frozen=True)
class Drives:
    """The identified quantities, as arrays along the arm's joints.

    Attributes:
        stiffness: [N m/rad or N/m].
        damping: [N m s/rad or N s/m], of drive and joint together.
        armature: [kg m2 or kg].
        friction: dry friction [N m or N].
        offset: encoder reading minus joint position [rad or m].
        delay: time from sending a target until it takes effect [s].
    """

    stiffness: np.ndarray
    damping: np.ndarray
    armature: np.ndarray
    friction: np.ndarray
    offset: np.ndarray
    delay: float = 0.0

    def vector(self) -> np.ndarray:
        """Returns all parameters as one vector [5 n + 1]: each parameter of all joints in turn, offsets, delay."""
        return np.concatenate([*(getattr(self, name) for name in POSITIVE), self.offset, [self.delay]])

    @classmethod
    def of(cls, vector: np.ndarray) -> "Drives":
        """Makes drives from a ``vector``."""
        stiffness, damping, armature, friction, offset = np.split(np.asarray(vector, float)[:-1], 5)
        return cls(stiffness, damping, armature, friction, offset, float(vector[-1]))


def usual_step(robot: RobotCfg) -> float:
    """Returns the physics step for a robot's drives [s]: ``USUAL``, or halves of it if a drive oscillates too fast for that."""
    fastest = Plant(robot, USUAL).oscillation
    return max(SHORTEST, USUAL / 2 ** np.ceil(np.log2(max(1.0, USUAL * fastest / _PHASE))))


class Plant:
    """Simulates an arm's drives; the gripper's drives hold still.

    Args:
        robot: the robot, with its model, gains and joints.
        dt: physics step [s].

    Attributes:
        model: compiled model with the robot's own parameters.
        nominal: the model's own parameters, with guesses for those that it lacks.

    Raises:
        UserError: the physics step cannot resolve the drives.
    """

    def __init__(self, robot: RobotCfg, dt: float):
        if not SHORTEST <= dt <= 0.02:
            raise UserError(f"dt takes a physics step from {SHORTEST:g} to 0.02 s, got {dt:g}")
        self.robot, self.dt, self.n = robot, dt, len(robot.arm.joints)
        self.model = scene.build(robot, SceneCfg(objects={}, table=False), SimCfg(dt=dt, iterations=50), visuals=False)
        self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_AUTORESET
        self.model.opt.tolerance = 1e-12  # finite differences need an accurate solver
        joints = self.model.actuator_trnid[: self.n, 0]
        self._at, self._dof = self.model.jnt_qposadr[joints], self.model.jnt_dofadr[joints]
        armature, friction = self.model.dof_armature[self._dof], self.model.dof_frictionloss[self._dof]
        self.nominal = Drives(
            np.array(robot.arm.stiffness),
            np.maximum(np.array(robot.arm.damping) + self.model.dof_damping[self._dof], 1e-3),
            np.maximum(armature, 1e-4),
            np.where(friction > 0, friction, FRICTION * np.array(robot.arm.effort)),
            np.zeros(self.n),
        )
        threads = cores()
        self._data = [mujoco.MjData(self.model) for _ in range(threads)]
        self._rollout = rollout.Rollout(nthread=threads).rollout

    @property
    def oscillation(self) -> float:
        """Rate of the fastest oscillation of a drive [rad/s]; 0: all are damped too strongly."""
        rates = np.sqrt(self.nominal.stiffness * self.model.dof_invweight0[self._dof])
        return float(np.max(rates, where=self.nominal.damping < 2 * self.nominal.stiffness / rates, initial=0.0))

    def finer(self) -> "Plant":
        """Returns the same arm with half the physics step."""
        return Plant(self.robot, max(self.dt / 2, SHORTEST))

    def with_drives(self, drives: Drives) -> mujoco.MjModel:
        """Returns the model with other parameters, whose damping belongs entirely to the drives."""
        model, n = copy.copy(self.model), self.n
        model.actuator_gainprm[:n, 0], model.actuator_biasprm[:n, 1] = drives.stiffness, -drives.stiffness
        model.actuator_biasprm[:n, 2], model.dof_damping[self._dof] = -drives.damping, 0.0
        model.dof_armature[self._dof], model.dof_frictionloss[self._dof] = drives.armature, drives.friction
        mujoco.mj_setConst(model, mujoco.MjData(model))
        return model

    def readings(
        self,
        drives: list[Drives],
        sent: Float[np.ndarray, " m"],
        targets: Float[np.ndarray, "m n"],
        start: np.ndarray,
        times: Float[np.ndarray, " k"],
    ) -> Float[np.ndarray, "b k n"]:
        """Simulates the encoders' readings at ``times``, for each of several parameter sets.

        Args:
            drives: parameter sets.
            sent: times of the targets, ascending [s].
            targets: targets [rad or m].
            start: readings before the first target was sent [n] [rad or m].
            times: times of the readings, none before the first target [s].

        Returns:
            readings of each parameter set [rad or m].

        Raises:
            UserError: the log is too long, or the simulation diverges.
        """
        m, n = self.model, self.n
        begin = sent[0] - REST
        steps = int(np.ceil((times[-1] - begin) / self.dt)) + 1
        if len(drives) * steps * (m.nq + m.nv + m.nu) > MAX_NUMBERS:
            text = f"{times[-1] - begin:.0f} s are too many physics steps of {self.dt:g} s"
            raise UserError(f"{text}: give a shorter log (a minute is enough) or a larger --dt")
        edges = begin + self.dt * np.arange(steps + 1)
        states = np.zeros((len(drives), 1 + m.nq + m.nv))
        states[:, 1 : 1 + m.nq] = m.qpos0
        home = np.concatenate([targets[0], self.robot.gripper.home])
        at = m.jnt_qposadr[m.actuator_trnid[:, 0]]
        states[:, 1 + at] = home
        ctrl = np.broadcast_to(home, (len(drives), steps, m.nu)).copy()
        for i, d in enumerate(drives):
            states[i, 1 + self._at] = start - d.offset
            ctrl[i, :, :n] = in_force(sent + d.delay, targets, edges)
        ctrl = np.clip(ctrl, *m.actuator_ctrlrange.T)
        models = [self.with_drives(d) for d in drives]
        path, _ = self._rollout(models, self._data, states, ctrl)
        whole = np.concatenate([states[:, None], path], axis=1)[:, :, 1 + self._at]
        if not np.isfinite(whole).all():
            raise UserError("the simulated arm diverges: give a smaller --dt, or gains that hold it")
        return np.stack([interpolate(times, edges, q) + d.offset for q, d in zip(whole, drives, strict=True)])


def in_force(since: np.ndarray, targets: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Computes the mean target over each physics step [steps, n]. Unlike the targets' stairs, it is smooth in the delay.

    Args:
        since: time at which each target took effect [m].
        edges: edges of the steps [steps + 1].
    """
    knots = np.concatenate([[min(edges[0], since[0]) - 1.0], since, [max(edges[-1], since[-1]) + 1.0]])
    held = np.concatenate([targets[:1], targets])
    integral = np.concatenate([np.zeros_like(held[:1]), np.cumsum(held * np.diff(knots)[:, None], axis=0)])
    return np.diff(interpolate(edges, knots, integral), axis=0) / np.diff(edges)[:, None]


def interpolate(at: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Interpolates the columns of ``y`` linearly."""
    return np.stack([np.interp(at, x, column) for column in y.T], axis=-1)
