"""DENSO Cobotta Pro 900 over b-CAP, in slave mode: the controller (RC9) takes joint targets every 8 ms.

The sequence follows DENSORobot/denso_robot_ros (``denso_robot_core``): connect to ``CaoProv.DENSO.VRC9``, TakeArm, Motor,
slvSendFormat, slvRecvFormat, slvChangeMode 0x202 (angles, and each slvMove waits for its turn), then slvMove with eight angles in
degrees, which answers with the joint positions. A thread does this. Between two targets of the policy it interpolates linearly,
smoothed over three cycles; without a new target it stays. It never switches motors off, releases the arm or clears an error.
"""

import collections
import threading
from collections.abc import Mapping
from typing import Any

import numpy as np

from mjx_nero.deploy.arm import ArmError, Clock, Feedback
from mjx_nero.deploy.drivers import bcap, rg6
from mjx_nero.deploy.drivers.turning import Turning
from mjx_nero.errors import UserError

CYCLE = 0.008  # [s]
ANGLES, SLAVE, NORMAL = 0x0002, 0x0202, 0
_SMOOTH = 3  # cycles
_PATIENCE = 0.5  # time limit for an answer [s]
_AXES = 8  # number of angles in a target
_UDP = "udp:"
_JOINTS = 6


class Cobotta:
    """The arm and its RG6 gripper.

    Args:
        host: ``HOST`` or ``HOST:PORT`` of the controller; with the prefix ``udp:`` it is reached by datagrams.
        gripper: the gripper; None: there is none, and its targets are reported as its positions.
    """

    def __init__(self, metadata: Mapping[str, Any], host: str, gripper: rg6.Rg6 | None, clock: Clock):
        self.joints = tuple(metadata["joints"]["names"])
        self._address, (self._host, _, port) = host, host.removeprefix(_UDP).partition(":")
        self._port, self._clock, self._gripper = int(port or bcap.PORT), clock, gripper
        self._dt = float(metadata["control_dt"])
        self._lock, self.turning = threading.Lock(), Turning(self.cycle)  # the controller sets the pace
        self._grip = np.array(metadata["joints"]["home"], float)[_JOINTS:]
        self._past: collections.deque[tuple[float, np.ndarray]] = collections.deque(maxlen=4)
        self._engaged = False

    def ranges(self) -> None:
        """See ``Arm``: the model's limits, which are the maker's."""

    def connect(self) -> None:
        """See ``Arm``."""
        try:
            self._call = bcap.Client(self._host, self._port, _PATIENCE, self._address.startswith(_UDP))
        except OSError as error:
            raise UserError(f"no controller answers at {self._address}: {error}") from None
        try:
            self._call(bcap.SERVICE_START, "")
            self._controller = self._call(bcap.CONNECT, "", "CaoProv.DENSO.VRC9", "localhost", "")
            names = self._call(bcap.ROBOT_NAMES, self._controller, "") or ["Arm"]
            self._robot = self._call(bcap.GET_ROBOT, self._controller, names[0], "")
            self._remember(self._angles(self._do("HighCurJntEx")[1:]))
        except ArmError as error:
            raise UserError(
                f"the controller at {self._address} refuses access: {error}. Set its executable token to Ethernet, with this "
                "computer's address"
            ) from None
        if self._gripper:
            self._gripper.connect()

    def _do(self, command: str, argument: Any = None) -> Any:
        return self._call(bcap.EXECUTE, self._robot, command, argument)

    def _angles(self, degrees: Any) -> np.ndarray:
        """Reads the arm's joint positions from an answer [rad].

        Raises:
            ArmError: the answer does not have them.
        """
        if not isinstance(degrees, list) or len(degrees) < _JOINTS or not all(isinstance(x, float) for x in degrees):
            raise ArmError("the controller's answer has no angles")
        return np.radians(degrees[:_JOINTS])

    def _remember(self, angles: np.ndarray) -> None:
        with self._lock:
            self._past.append((self._clock.now(), angles))

    def engage(self) -> None:
        """See ``Arm``: switches motors on, then sends the present positions as targets in every cycle."""
        self._do("TakeArm", [0, 1])
        self._do("Motor", [1, 0])
        self._do("slvSendFormat", 0)
        self._do("slvRecvFormat", ANGLES)
        here = self._angles(self._do("HighCurJntEx")[1:])
        self._remember(here)
        self._from, self._to, self._since = here, here, self._clock.now()
        self._sent = collections.deque([here] * _SMOOTH, maxlen=_SMOOTH)
        self._do("slvChangeMode", SLAVE)
        self._engaged = True
        if self._address.startswith(_UDP):
            self._call.patience = 2 * CYCLE
        if self._gripper:
            self._gripper.engage()
        self.turning.start()

    def cycle(self) -> None:
        """Sends one target and reads the answer."""
        with self._lock:
            self._sent.append(self._path(self._clock.now()))
        degrees = np.degrees(np.mean(self._sent, axis=0)).tolist()
        answer = self._do("slvMove", degrees + [0.0] * (_AXES - _JOINTS))
        self._remember(self._angles(answer[0] if answer and isinstance(answer[0], list) else answer))

    def _path(self, now: float) -> np.ndarray:
        """Returns the present target: on a straight line to the last target, which it reaches after one control step."""
        share = min(max((now - self._since) / self._dt, 0.0), 1.0)
        return self._from + share * (self._to - self._from)

    def read(self) -> Feedback:
        """See ``Arm``: the newest answer; velocities are differences over a few cycles."""
        self.turning.check()
        if not self._engaged:
            self._remember(self._angles(self._do("HighCurJntEx")[1:]))
        with self._lock:
            (first, before), (now, at) = self._past[0], self._past[-1]
        speed = (at - before) / (now - first) if now - first > CYCLE / 2 else np.zeros(_JOINTS)
        grip = self._grip
        if self._gripper:
            left = rg6.angle(self._gripper.read())
            grip = np.array([left, -left])
        return Feedback(now, np.concatenate([at, grip]), np.concatenate([speed, np.zeros(2)]))

    def command(self, position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """See ``Arm``: the thread moves to the target within one control step."""
        self.turning.check()
        with self._lock:
            now = self._clock.now()
            self._from, self._to, self._since = self._path(now), position[:_JOINTS].copy(), now
        self._grip = position[_JOINTS:].copy()
        if self._gripper:
            self._gripper.command(rg6.width(float(position[_JOINTS] - position[_JOINTS + 1]) / 2))
        return position

    def close(self) -> None:
        """See ``Arm``: leaves slave mode at rest. The controller holds the arm with motors on."""
        self.turning.stop()
        try:
            if self._engaged:
                for _ in range(_SMOOTH):
                    self.cycle()
                self._call.patience = _PATIENCE
                self._do("slvChangeMode", NORMAL)
        except ArmError:
            pass  # the controller has left slave mode by itself
        if self._gripper:
            self._gripper.close()
        self._call.close()


def of(metadata: Mapping[str, Any], clock: Clock, port: str | None, gripper: str | None = None, **_: Any) -> Cobotta:
    """Makes the driver of the arm at an address.

    Raises:
        UserError: the address is invalid.
    """
    assert port
    for flag, address in (("--port", port), ("--gripper", gripper)):
        host, colon, number = (address or "x").removeprefix(_UDP if flag == "--port" else "").partition(":")
        if not host or (colon and not (number.isdecimal() and int(number) < 65536)):
            raise UserError(
                f"{flag} of a Cobotta takes HOST or HOST:PORT{' (or udp:HOST)' * (flag == '--port')}, got {address!r}"
            )
    return Cobotta(metadata, port, rg6.Rg6(gripper) if gripper else None, clock)
