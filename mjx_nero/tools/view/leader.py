"""Steers the robot by a leader arm: LeRobot's SO-101 leader, which a person moves by hand.

An SO-ARM copies the leader's joints. On other robots the hand copies the movement of the leader's hand, starting from where both
are when the leader takes over, and the gripper copies the leader's opening.
"""

import functools
import pathlib
import threading
import time
from collections.abc import Callable
from typing import Protocol

import jax
import jax.numpy as jnp
import numpy as np

from mjx_nero import math
from mjx_nero.data.units import LEROBOT
from mjx_nero.deploy.arm import ArmError, Feedback
from mjx_nero.deploy.guard import WallClock
from mjx_nero.envs.env import ManipulationEnv
from mjx_nero.errors import UserError
from mjx_nero.interop import description
from mjx_nero.learn.play import rollout
from mjx_nero.mdp.actions import rate_limit
from mjx_nero.sim import kinematics, scene
from mjx_nero.tasks import registry
from mjx_nero.tools.view.hand import NAME as HAND
from mjx_nero.tools.view.hand import Hand
from mjx_nero.tools.view.log import LOG
from mjx_nero.tools.view.panel import Panel
from mjx_nero.tools.view.session import Session

NAME = "leader arm"
HZ = 50.0
PATIENCE_S = 0.5  # time without an answer after which the robot stays where it is
_MODEL = "so_arm101"


class Readable(Protocol):
    """An arm that can be read."""

    def connect(self) -> None: ...
    def read(self) -> Feedback: ...
    def close(self) -> None: ...


def at(port: str, calibration: pathlib.Path | None) -> Readable:
    """Connects to the leader at a serial port.

    Raises:
        UserError: no calibration file is given, or no arm that matches the calibration answers.
    """
    from mjx_nero.deploy.drivers import so_leader

    if calibration is None:
        raise UserError("--leader needs --calibration: the leader's file written by lerobot-calibrate")
    made = so_leader.of(description.robot(registry.robot(_MODEL)), port, calibration, WallClock())
    made.connect()
    return made


def same_joints(env: ManipulationEnv) -> bool:
    """Returns whether the robot has the leader's joints."""
    return env.cfg.robot.name in LEROBOT


def agent(env: ManipulationEnv) -> rollout.Agent:
    """Makes an agent that moves the joints to its parameters [joints], at the drives' speed."""
    robot = env.cfg.robot
    step = jnp.array(robot.arm.speed + robot.gripper.speed, jnp.float32) * env.dt

    def act(wanted, points, state, key):
        points = jax.vmap(lambda point: rate_limit(wanted, point, step=step))(points)
        return points, points

    return rollout.through_actions(env, rollout.Agent(act, init=jax.vmap(lambda state: env.view(state).joint_pos)))


class Leader:
    """Reads an arm in a thread, and passes on its joint positions.

    Args:
        arm: a connected arm.
        follow: called with the joint positions [rad].

    Attributes:
        position: joint positions as last read [rad].
    """

    def __init__(self, arm: Readable, follow: Callable[[np.ndarray], None]):
        self._arm, self._follow, self._ended = arm, follow, threading.Event()
        self.position = arm.read().position
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Ends the thread and closes the port. The arm's torque stays off."""
        self._ended.set()
        self._thread.join(timeout=2)
        self._arm.close()

    def _run(self) -> None:
        heard = time.monotonic()
        while not self._ended.wait(1 / HZ):
            try:
                self.position, heard = self._arm.read().position, time.monotonic()
                self._follow(self.position)
            except ArmError as error:
                if time.monotonic() - heard > PATIENCE_S:
                    LOG.warning("the leader arm does not answer, so the robot stays where it is: %s", error)


class Way:
    """Copies the movement of a leader's hand to the hand of another robot."""

    def __init__(self, hand: Hand):
        robot = registry.robot(_MODEL)
        chain = kinematics.Chain(scene.robot_model(robot), robot.joints, [robot.ee_site])
        self._hand, self._poses = hand, jax.jit(lambda joints: tuple(x[0] for x in chain.poses(joints)))
        self._fingers = tuple(np.array(x) for x in (robot.gripper.open, robot.gripper.close))
        self._from: tuple | None = None

    def begin(self) -> None:
        """Starts from the poses of both hands at the next step."""
        self._hand.here()
        self._from = None

    def step(self, joints: np.ndarray) -> None:
        """Moves the robot's hand as the leader's hand moved.

        Args:
            joints: joint positions of the leader [rad].
        """
        pos, quat = self._poses(jnp.asarray(joints, jnp.float32))
        if self._from is None:
            self._from = pos, quat, self._hand.pos.copy(), jnp.asarray(self._hand.quat, jnp.float32)
        pos0, quat0, own, own_quat = self._from
        turned = math.quat_mul(math.quat_mul(quat, math.quat_conj(quat0)), own_quat)
        opened, closed = self._fingers
        n = len(opened)
        self._hand.put(
            own + np.asarray(pos - pos0), np.asarray(turned), float(np.mean((joints[-n:] - closed) / (opened - closed)))
        )


def attached(
    arm: Readable, session: Session, panel: Panel, hand: Hand, take_over: Callable[[str], bool]
) -> tuple[Leader, Callable[[], object]]:
    """Starts reading the arm; returns its reader, and a function that lets it take over.

    Args:
        take_over: lets one of the user's agents act, by name.
    """
    if same_joints(session.env):

        def copy(joints: np.ndarray) -> None:
            if panel.agent.value == NAME:
                session.params = jnp.asarray(joints, jnp.float32)

        made = Leader(arm, copy)
        panel.parameters[NAME] = lambda: jnp.asarray(made.position, jnp.float32)
        return made, functools.partial(take_over, NAME)

    way, follows = Way(hand), threading.Event()

    def go(joints: np.ndarray) -> None:
        if follows.is_set() and panel.agent.value == HAND:
            way.step(joints)
        else:
            follows.clear()

    def begin() -> None:
        way.begin()
        take_over(HAND)
        follows.set()

    return Leader(arm, go), begin
