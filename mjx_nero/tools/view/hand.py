"""Lets the user drag or steer the robot's hand, and records demonstrations."""

import pathlib
import threading
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_nero import math
from mjx_nero.control.ik import IkCfg, InverseKinematics
from mjx_nero.data import Episode, Schema, check_writable, writer
from mjx_nero.data import episode as names
from mjx_nero.envs.env import ManipulationEnv
from mjx_nero.errors import UserError
from mjx_nero.learn.play import rollout
from mjx_nero.learn.play.recorder import Record
from mjx_nero.mdp.actions import rate_limit
from mjx_nero.sim import kinematics
from mjx_nero.tools.demos import making
from mjx_nero.tools.view import tape
from mjx_nero.tools.view.session import Frame, Session

NAME = "your hand"
STEP = 0.01  # movement per key press [m]
TURN = 10.0  # rotation per key press [degrees]
# On an arm with few joints the hand's position has priority over its orientation.
_IK = IkCfg(orientation_weight=0.03, restarts=0)


def agent(env: ManipulationEnv) -> rollout.Agent:
    """Makes an agent that moves the hand to its parameters at the drives' speed: ``pos`` [m], ``quat`` (wxyz), and ``open``,
    from 0 to 1.

    If there are several robots, only the first moves.
    """
    robot, ik = env.cfg.robot, InverseKinematics(env.cfg.robot, cfg=_IK)
    n, own, step = len(robot.arm.joints), len(robot.joints), np.array(robot.arm.speed + robot.gripper.speed, np.float32) * env.dt
    opened, closed = (np.array(x, np.float32) for x in (robot.gripper.open, robot.gripper.close))

    def one(asked, point):
        arm = ik.local(asked["pos"], asked["quat"], point[:n]).q
        fingers = closed + asked["open"] * (opened - closed)
        moved = rate_limit(jnp.concatenate([arm, fingers]), point[:own], step=jnp.asarray(step))
        return jnp.concatenate([moved, point[own:]])

    def act(asked, points, state, key):  # its own set-points, because drive targets may be far ahead of the joints
        points = jax.vmap(one, (None, 0))(asked, points)
        return points, points

    return rollout.through_actions(env, rollout.Agent(act, init=jax.vmap(lambda state: env.view(state).joint_pos)))


class Hand:
    """The pose to which the user steers the hand of a session's robots.

    Args:
        take_over: called when the user steers; returns True if another agent acted until then.
    """

    def __init__(self, session: Session, take_over: Callable[[], bool]):
        env = session.env
        self._session, self._take_over = session, take_over
        self._pose = jax.jit(kinematics.site_pose_fn(env.physics_model, env.cfg.robot.ee_site))
        self._lock, self._steered = threading.Lock(), False
        self.pos, self.quat, self.open = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), 1.0
        self.here()

    def here(self) -> None:
        """Makes the current pose the wanted one."""
        pos, quat = self._pose(jnp.asarray(self._session.frame.qpos[0], jnp.float32))
        with self._lock:
            self.pos, self.quat = np.array(pos, float), np.array(quat, float)

    def begin(self) -> dict[str, jax.Array]:
        """Returns the agent's first parameters: the hand stays where it is, unless steering made the agent begin."""
        if not self._steered:
            self.here()
        self._steered = False
        return self.asked

    @property
    def asked(self) -> dict[str, jax.Array]:
        """Returns the agent's parameters."""
        with self._lock:
            return {
                "pos": jnp.asarray(self.pos, jnp.float32),
                "quat": jnp.asarray(self.quat, jnp.float32),
                "open": jnp.float32(self.open),
            }

    def move(self, to: np.ndarray) -> None:
        """Moves the wanted pose to a point in the world [m]."""
        self._steer(lambda: setattr(self, "pos", np.asarray(to, float)))

    def shift(self, by: tuple[float, float, float]) -> None:
        """Moves the wanted pose by a vector in the world [m]."""
        self._steer(lambda: setattr(self, "pos", self.pos + by))

    def turn(self, degrees: float) -> None:
        """Turns the wanted pose about the vertical, by degrees."""
        by = math.axis_angle(jnp.array([0.0, 0.0, 1.0]), jnp.radians(degrees))
        self._steer(lambda: setattr(self, "quat", np.array(math.quat_mul(by, jnp.asarray(self.quat, jnp.float32)), float)))

    def grip(self, share: float) -> None:
        """Sets how far the gripper is to open, from 0 to 1."""
        self._steer(lambda: setattr(self, "open", float(np.clip(share, 0.0, 1.0))))

    def put(self, pos: np.ndarray, quat: np.ndarray, share: float) -> None:
        """Sets the wanted pose in the world, and how far the gripper is to open."""
        wanted = {"pos": np.asarray(pos, float), "quat": np.asarray(quat, float), "open": float(np.clip(share, 0.0, 1.0))}
        self._steer(lambda: self.__dict__.update(wanted))

    def _steer(self, change: Callable[[], None]) -> None:
        begins = self._take_over()
        if begins:  # the new agent takes its parameters when it begins
            self.here()
            self._steered = True
        with self._lock:
            change()
        if not begins:
            self._session.params = self.asked


class Recording:
    """Records the first environment of a session, and writes it as an episode of a data set.

    Args:
        out: folder of the data set.
        env_name, preset, fields: environment of the session.
    """

    def __init__(
        self,
        session: Session,
        out: pathlib.Path,
        env_name: str,
        preset: str,
        form: str = "lerobot",
        fields: Mapping[str, Any] | None = None,
    ):
        self._session, self._out, self._form = session, out, form
        env = session.env
        self._units = making.units_of(env, "auto")
        self._pose = jax.jit(jax.vmap(kinematics.site_pose_fn(env.physics_model, env.cfg.robot.ee_site)))
        about = {
            "env": env_name,
            "preset": preset,
            "robot": env.cfg.robot.name,
            "robot_folder": env.cfg.robot.folder,
            "env_fields": {key: str(value) for key, value in (fields or {}).items()},
            "agent": NAME,
            "through": "task",
            "actions": "joints",
            "holds": "all",
            "units": self._units.to_json(),
        }
        robot = making.robot_type(env.cfg.robot.name, self._units)
        kept = making.features(env, self._units, "joints")
        self.schema = Schema(1 / env.dt, robot, making.sentence(env_name), kept, about)
        self._steps: list[tuple[np.ndarray, Record]] = []
        self.on, self._lock = False, threading.Lock()  # the session steps in its own thread
        session.recorders.append(self)

    def __call__(self, record: Record) -> None:
        """Records a step. The end of the task's episode also ends the recording."""
        with self._lock:
            if self.on:
                before = self._session.frame.qpos[0].astype(np.float32)  # the frame is still the one before the step
                one = jax.tree.map(lambda x: np.array(x[0]), record)
                self._steps.append((before, one))
                self.on = not one.done

    def __len__(self) -> int:
        return len(self._steps)

    def check(self) -> None:
        """Checks before anybody steers that ``save`` can add to the data set.

        Raises:
            UserError: the folder holds something else, or a package is missing.
        """
        check_writable(self._out, self.schema, self._form)

    def tape(self) -> Iterator[Frame]:
        """Returns the recorded frames."""
        goals = [np.concatenate([one.scenery.goal_pos_w, one.scenery.goal_quat_w]) for _, one in self._steps]
        return tape.frames(self._session.frame, [qpos.astype(float) for qpos, _ in self._steps], np.array(goals))

    def begin(self) -> None:
        """Starts recording."""
        with self._lock:
            self._steps, self.on = [], True

    def discard(self) -> None:
        """Discards the recording."""
        with self._lock:
            self._steps, self.on = [], False

    def save(self) -> str:
        """Adds the recording to the data set as a success, which the user confirms by saving; returns a line to show.

        Raises:
            UserError: nothing was recorded, or it cannot be written.
        """
        with self._lock:
            self.on = False
        if not self._steps:
            raise UserError("nothing was recorded: press Record first")
        with writer(self._out, self.schema, self._form) as form:
            number = int(form.numbers[-1]) + 1 if len(form.numbers) else 0
            form.put([Episode(self._arrays(), True, number)])
            count = len(form.lengths)
        steps, self._steps = len(self._steps), []
        return f"{steps} steps saved; {self._out} has {count} episodes"

    def _arrays(self) -> dict[str, np.ndarray]:
        """Returns the features of the steps, as ``demonstrations.Player`` does."""
        env = self._session.env
        before = np.stack([qpos for qpos, _ in self._steps])
        record: Any = jax.tree.map(lambda *x: np.stack(x), *(one for _, one in self._steps))
        at = [int(env.physics_model.joint(joint).qposadr[0]) for joint in env.cfg.robot.joints]
        things = [int(env.physics_model.joint(name).qposadr[0]) for name in env.cfg.scene.objects]
        poses = [*self._pose(before), *(before[:, i : i + 7] for i in things)]
        poses += [record.scenery.goal_pos_w, record.scenery.goal_quat_w]
        seen = [x.reshape(len(before), -1) for x in jax.tree.leaves(record.obs["state"])]
        last = np.arange(len(before))[:, None] == len(before) - 1
        told = self._units.shown(record.targets)
        arrays = {
            names.STATE: self._units.shown(before[:, at]),
            names.ENVIRONMENT: np.concatenate([np.asarray(x) for x in poses], axis=1),
            names.ACTION: told,
            names.EXECUTED: told,
            names.SEEN: np.concatenate(seen, axis=1),
            names.DONE_BY: record.action,
            names.QPOS: before,
            names.REWARD: record.reward[:, None],
            names.DONE: last,
            names.SUCCESS: last,
        }
        return {name: np.asarray(x, self.schema.features[name].dtype) for name, x in arrays.items()}
