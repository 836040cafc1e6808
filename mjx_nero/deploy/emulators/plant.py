"""A scene in MuJoCo's C library that keeps up with a clock, for the simulated arm and the emulators."""

import collections
import copy
import dataclasses
import functools
import pathlib
import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar, cast

import mujoco
import numpy as np

from mjx_nero.deploy.arm import Clock
from mjx_nero.deploy.places import Sender, sender

_SLOW = 0.02  # damping over stiffness of a drive that counts as slow [s]
_LONGEST = 0.5  # maximum time to catch up at once [s]; after a longer pause of the program the arm has not moved on

Method = TypeVar("Method", bound=Callable[..., Any])


@dataclasses.dataclass
class Faults:
    """Faults of the plant, which can be set while it runs.

    Attributes:
        stalled: indices of joints that stand still.
        late: delay from a target's arrival until it takes effect [s].
        stiffness: stiffness of the drives, as a share of the model's.
    """

    stalled: frozenset[int] = frozenset()
    late: float = 0.0
    stiffness: float = 1.0


def _alone(method: Method) -> Method:
    """Lets only one thread at a time into a plant, because MuJoCo's data is not thread-safe and an emulator may have a thread."""

    @functools.wraps(method)
    def locked(plant: "Plant", *args: Any, **kwargs: Any) -> Any:
        with plant._lock:
            return method(plant, *args, **kwargs)

    return cast(Method, locked)


def of(
    metadata: Mapping[str, Any],
    clock: Clock,
    model: str,
    tracker: int | None = None,
    start: Sequence[float] | None = None,
    objects: Mapping[str, Sequence[float]] | None = None,
    faults: Mapping[str, Any] | None = None,
) -> "Plant":
    """Makes the plant of a policy's or a robot's metadata.

    Args:
        model: file of the scene (``.mjb``).
        tracker: port of this machine to which object positions are sent.
        start: first positions of the joints [rad or m]; None: home.
        objects: first positions of the objects, in the root frame [m].
        faults: fields of ``Faults``.
    """
    own = metadata["joints"]
    at = np.array(own["home"] if start is None else start, float)
    told = sender("127.0.0.1", tracker) if tracker else None
    plant = Plant(pathlib.Path(model), own["names"], at, clock, metadata["base"]["position"], told)
    plant.faults = Faults(**(faults or {}))
    plant.reset(at, {name: np.array(position, float) for name, position in (objects or {}).items()})
    return plant


class Plant:
    """Position drives with objects around them. Several threads may use it.

    Args:
        model: compiled scene whose actuators are the drives, or its file (``.mjb``).
        joints: names of the joints, in the order of targets and readings.
        start: first positions of the joints [rad or m].
        base: position of the robot's root frame in the world [m].
        tracker: called with the objects' positions after every advance.

    Attributes:
        faults: faults of the arm.
        powered: which drives have torque.
        gears: damping of the drives without torque [N m s/rad].
    """

    def __init__(
        self,
        model: mujoco.MjModel | pathlib.Path,
        joints: Sequence[str],
        start: np.ndarray,
        clock: Clock,
        base: Sequence[float] = (0.0, 0.0, 0.0),
        tracker: Sender | None = None,
    ):
        self._lock = threading.RLock()
        if not isinstance(model, mujoco.MjModel):
            model = mujoco.MjModel.from_binary_path(str(model))
        self.model = copy.copy(model)  # a copy, because the drives' gains change
        self.data, self._clock, self._base, self._tracker = mujoco.MjData(self.model), clock, np.asarray(base, float), tracker
        m, ids = self.model, [self.model.joint(name).id for name in joints]
        self._qpos, self._dof = m.jnt_qposadr[ids], m.jnt_dofadr[ids]
        self._act = np.array([int(np.flatnonzero(m.actuator_trnid[:, 0] == j)[0]) for j in ids])
        self._gain, self._bias = m.actuator_gainprm[self._act, 0].copy(), m.actuator_biasprm[self._act].copy()
        self._effort = np.abs(m.actuator_forcerange[self._act]).max(axis=1)
        free = [j for j in range(m.njnt) if m.jnt_type[j] == mujoco.mjtJoint.mjJNT_FREE]
        self.objects = {m.joint(j).name: int(m.jnt_qposadr[j]) for j in free}
        self.faults, self.powered, self.gears = Faults(), np.ones(len(ids), bool), 0.0
        self._waiting: collections.deque[tuple[float, np.ndarray]] = collections.deque()
        self.reset(start)

    @_alone
    def reset(self, start: np.ndarray, objects: dict[str, np.ndarray] | None = None) -> None:
        """Puts the arm at rest at positions [rad or m] that its drives hold, and objects at positions [m] in the root frame."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[self._qpos] = self._targets = np.array(start, float)
        self._couple()
        for name, position in (objects or {}).items():
            self.data.qpos[self.objects[name] :][:3] = position + self._base
        self.data.ctrl[self._act] = self._targets
        mujoco.mj_forward(self.model, self.data)
        self._waiting.clear()
        self._begun = self._clock.now()
        self._tell()

    @_alone
    def stiffen(self) -> None:
        """Turns slow drives into position servos: ten times as stiff, and critically damped."""
        soft = -self._bias[:, 2] > _SLOW * self._gain
        inertia = 1 / self.model.dof_invweight0[self._dof]
        stiffness = np.where(soft, 10 * self._gain, self._gain)
        damping = np.where(soft, 2 * np.sqrt(stiffness * inertia), -self._bias[:, 2])
        self._gain, self._bias[:, 1], self._bias[:, 2] = stiffness, -stiffness, -damping
        fastest = float(np.sqrt(stiffness / inertia).max())
        while fastest * self.model.opt.timestep > 1:
            self.model.opt.timestep /= 2  # several physics steps per oscillation of a servo

    def _couple(self) -> None:
        """Puts joints that follow others where these require."""
        m, q = self.model, self.data.qpos
        for e in np.flatnonzero(m.eq_type == mujoco.mjtEq.mjEQ_JOINT):
            if m.eq_obj2id[e] >= 0:
                follower, leader = (int(m.jnt_qposadr[j]) for j in (m.eq_obj1id[e], m.eq_obj2id[e]))
                powers = (q[leader] - m.qpos0[leader]) ** np.arange(5)
                q[follower] = m.qpos0[follower] + powers @ m.eq_data[e, :5]

    @_alone
    def advance(self) -> None:
        """Catches up with the clock."""
        now = self._clock.now() - self._begun
        if now - self.data.time > _LONGEST:
            self._begun += now - self.data.time - _LONGEST
            now = self.data.time + _LONGEST
        if now < self.data.time + self.model.opt.timestep:
            return
        self._set_drives()
        still, stalled = self.data.qpos[self._qpos].copy(), sorted(self.faults.stalled)
        while self.data.time + self.model.opt.timestep <= now + 1e-9:
            while self._waiting and self._waiting[0][0] <= self.data.time + 1e-9:
                self._targets = self._waiting.popleft()[1]
            self.data.ctrl[self._act] = self._targets
            mujoco.mj_step(self.model, self.data)
            if stalled:
                self.data.qpos[self._qpos[stalled]], self.data.qvel[self._dof[stalled]] = still[stalled], 0.0
        self._tell()

    def _set_drives(self) -> None:
        """Applies the drives' present stiffness and power to the model."""
        m, share = self.model, np.where(self.powered, self.faults.stiffness, 0.0)
        m.actuator_gainprm[self._act, 0], m.actuator_biasprm[self._act, 1] = self._gain * share, self._bias[:, 1] * share
        m.actuator_biasprm[self._act, 2] = np.where(self.powered, self._bias[:, 2], -self.gears)

    def _tell(self) -> None:
        if self._tracker:
            for name, at in self.objects.items():
                self._tracker(name, self.data.qpos[at:][:3] - self._base, self.data.qpos[at:][3:7])

    @_alone
    def place(self, name: str) -> np.ndarray:
        """Returns an object's position in the root frame [m]."""
        return self.data.qpos[self.objects[name] :][:3] - self._base

    @_alone
    def position(self) -> np.ndarray:
        """Returns the joints' positions [rad or m]."""
        return self.data.qpos[self._qpos].copy()

    @_alone
    def velocity(self) -> np.ndarray:
        """Returns the joints' velocities [rad/s or m/s]."""
        return self.data.qvel[self._dof].copy()

    @_alone
    def load(self) -> np.ndarray:
        """Returns the drives' torques as signed shares of their maximum."""
        return self.data.actuator_force[self._act] / self._effort

    @property
    def time(self) -> float:
        """Time since the last reset [s]."""
        return self._clock.now() - self._begun

    @_alone
    def target(self, targets: np.ndarray, later: float = 0.0) -> None:
        """Sets new targets of the drives [rad or m], which take effect after ``faults.late`` plus ``later`` [s]."""
        self._waiting.append((self.time + self.faults.late + later, np.array(targets, float)))
