"""AgileX's Piper and Nero over CAN, by python-can, with the frames that the maker publishes.

Sources: agilexrobotics/piper_sdk (``piper_msgs/msg_v2``) for the Piper; agilexrobotics/pyAgxArm (``protocols/can_protocol``) for
the Nero, whose frames are the Piper's plus those of a seventh joint. All numbers are big-endian. Targets are sent in joint mode,
whose frames are the same in all of the Nero's firmware up to 1.20; versions differ in torque mode, which is not used here. Byte 6
of the mode, which switches the Nero's own messages on and off, is 0, which leaves them unchanged. The driver never sends 0x150,
whose resume drops the arm, and never disables a motor.
"""

import dataclasses
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np

from mjx_nero.deploy.arm import ArmError, Clock, Feedback
from mjx_nero.errors import UserError


@dataclasses.dataclass(frozen=True)
class Model:
    """The CAN frames of one arm.

    Attributes:
        name: the arm's name, for messages.
        targets, joints: frames of target and present positions, two joints per frame.
        fast, slow: frames of each joint's speed, and of its motor's state.
        everyone: joint number that means all joints.
        hint: what to check if nothing is received.
    """

    name: str
    targets: tuple[int, ...]
    joints: tuple[int, ...]
    fast: tuple[int, ...]
    slow: tuple[int, ...]
    everyone: int
    hint: str

    @property
    def count(self) -> int:
        """Number of joints."""
        return len(self.fast)


_HINT = "is it powered, and is the bus up at 1 Mbit/s?"
PIPER = Model(
    "Piper", (0x155, 0x156, 0x157), (0x2A5, 0x2A6, 0x2A7), tuple(range(0x251, 0x257)), tuple(range(0x261, 0x267)), 7, _HINT
)
NERO = Model(
    "Nero",
    (*PIPER.targets, 0x170),
    (*PIPER.joints, 0x2A9),
    (*PIPER.fast, 0x257),
    (*PIPER.slow, 0x267),
    8,
    f"{_HINT[:-1]}, and is its CAN push on (the arm's web page has the switch)?",
)
MODELS = {"piper": PIPER, "nero": NERO}

BITRATE = 1_000_000
MODE, GRIPPER, ENABLE = 0x151, 0x159, 0x471
STATUS, GRIPPED = 0x2A1, 0x2A8
MILLIDEGREE, MICROMETRE = np.pi / 180_000, 1e-6
BY_CAN, JOINT_MODE, FULL_SPEED = 1, 1, 100
ON = 2
GRIP = 1000  # [0.001 N m]
ENABLED = 1 << 6
ERRORS = {
    1: "low voltage",
    2: "a hot motor",
    4: "overcurrent",
    8: "a hot driver",
    16: "a collision",
    32: "an error",
    128: "a stall",
}
ARM_ERRORS = {
    1: "an emergency stop",
    4: "a target beyond its limits",
    5: "a joint that is not heard",
    6: "a brake that is shut",
    7: "a collision",
    9: "a joint's error",
    14: "heat",
    15: "heat",
}
_WAIT = 2.0  # [s] time limit for the first feedback, and for enabling motors
_OPENING = 0.1  # [s] time that a serial adapter needs to open


def pack(arm: np.ndarray) -> list[bytes]:
    """Packs angles [rad], two per frame; the last frame may have only one."""
    counts = [int(x) for x in np.rint(arm / MILLIDEGREE)]
    return [struct.pack(">ii", *(counts[k : k + 2] + [0])[:2]) for k in range(0, len(counts), 2)]


def unpack(frames: list[bytes], count: int) -> np.ndarray:
    """Unpacks the frames of ``pack``; returns angles [rad]."""
    return np.concatenate([struct.unpack(">ii", data) for data in frames])[:count] * MILLIDEGREE


def target_frames(model: Model, arm: np.ndarray, stroke: float) -> list[tuple[int, bytes]]:
    """Makes the frames with targets of the arm's joints [rad] and of the gripper's opening [m]."""
    mode = bytes([BY_CAN, JOINT_MODE, FULL_SPEED, 0, 0, 0, 0, 0])
    grip = struct.pack(">ihBB", round(stroke / MICROMETRE), GRIP, 1, 0)
    return [(MODE, mode), *zip(model.targets, pack(arm), strict=True), (GRIPPER, grip)]


class Agilex:
    """The arm on a CAN bus. Its two fingers move together: each joint is half the opening, with opposite signs.

    Args:
        port: python-can's ``INTERFACE:CHANNEL``.
    """

    def __init__(self, model: Model, metadata: Mapping[str, Any], port: str, clock: Clock):
        self.joints = tuple(metadata["joints"]["names"])
        self._model, self._port, self._clock = model, port, clock
        self._frames: dict[int, tuple[float, bytes]] = {}
        self._engaged = False

    def ranges(self) -> None:
        """See ``Arm``: the model's limits, which are the maker's."""

    def connect(self) -> None:
        """See ``Arm``."""
        import can  # python-can, of the extra ``deploy``

        interface, colon, channel = self._port.partition(":")
        if not colon or not channel:
            raise UserError(f"--port of a {self._model.name} takes INTERFACE:CHANNEL, as in socketcan:can0, got {self._port!r}")
        try:
            if interface == "slcan":
                from mjx_nero.deploy.drivers.slcan import Slcan

                self._bus: can.BusABC = Slcan(channel, bitrate=BITRATE, sleep_after_open=_OPENING, timeout=0)
            else:
                self._bus = can.Bus(interface=interface, channel=channel, bitrate=BITRATE)
        except (can.CanError, OSError, ValueError, TypeError) as error:
            raise UserError(f"cannot open {self._port}: {error}") from None
        self._error = can.CanError
        model, end = self._model, self._clock.now() + _WAIT
        while not all(frame in self._frames for frame in (STATUS, *model.joints, GRIPPED, *model.fast, *model.slow)):
            if self._clock.now() > end:
                self.close()
                raise UserError(f"no {model.name} answers at {self._port}: {model.hint}")
            self._wait()

    def _wait(self) -> None:
        """Waits briefly, and receives frames."""
        self._clock.sleep_until(self._clock.now() + 0.01)
        self._listen()

    def _listen(self) -> None:
        """Receives all frames that have arrived."""
        try:
            for _ in range(2000):
                message = self._bus.recv(0.0)
                if message is None:
                    return
                if not message.is_extended_id and not message.is_error_frame and len(message.data) == 8:
                    self._frames[message.arbitration_id] = self._clock.now(), bytes(message.data)
        except (self._error, OSError, ValueError, LookupError) as error:  # also if a serial adapter's line is cut short
            raise ArmError(f"the CAN bus fails: {error}") from None

    def _send(self, frames: list[tuple[int, bytes]]) -> None:
        import can

        try:
            for frame, data in frames:
                self._bus.send(can.Message(arbitration_id=frame, data=data, is_extended_id=False), timeout=0.02)
        except (self._error, OSError, ValueError) as error:
            raise ArmError(f"the CAN bus fails: {error}") from None

    def _targets(self, position: np.ndarray) -> list[tuple[int, bytes]]:
        n = self._model.count
        return target_frames(self._model, position[:n], float(position[n] - position[n + 1]))

    def engage(self) -> None:
        """See ``Arm``: sends the present positions as targets before it enables the motors."""
        position = self.read_position()[1]
        self._send(self._targets(position))
        end = self._clock.now() + _WAIT
        while not all(self._frames[frame][1][5] & ENABLED for frame in self._model.slow):
            if self._clock.now() > end:
                raise ArmError("the motors cannot be enabled")
            self._send([(ENABLE, bytes([self._model.everyone, ON, 0, 0, 0, 0, 0, 0]))])
            self._wait()
        self._send(self._targets(position))
        self._engaged = True

    def read_position(self) -> tuple[float, np.ndarray]:
        """Returns the positions of the joints [rad or m], and when the oldest of them arrived [s], first."""
        frames = [self._frames[frame] for frame in (*self._model.joints, GRIPPED)]
        arm = unpack([data for _, data in frames[:-1]], self._model.count)
        half = struct.unpack(">i", frames[-1][1][:4])[0] * MICROMETRE / 2
        return min(when for when, _ in frames), np.array([*arm, half, -half])

    def read(self) -> Feedback:
        """See ``Arm``: the newest feedback, which the arm sends by itself about 200 times per second."""
        self._listen()
        self._check()
        when, position = self.read_position()
        speeds = [struct.unpack(">h", self._frames[frame][1][:2])[0] / 1000 for frame in self._model.fast]
        heat = [max(struct.unpack(">hb", self._frames[frame][1][2:5])) for frame in self._model.slow]
        return Feedback(when, position, np.array([*speeds, 0.0, 0.0]), None, np.array([*heat, 0.0, 0.0], float))

    def _check(self) -> None:
        """Checks the arm's status.

        Raises:
            ArmError: the arm reports a fault.
        """
        if (status := self._frames[STATUS][1][1]) in ARM_ERRORS:
            raise ArmError(f"the arm reports {ARM_ERRORS[status]}")
        for joint, frame in enumerate(self._model.slow, 1):
            state = self._frames[frame][1][5]
            if said := [text for bit, text in ERRORS.items() if state & bit]:
                raise ArmError(f"joint {joint} reports {' and '.join(said)}")
            if self._engaged and not state & ENABLED:
                raise ArmError(f"joint {joint} has lost its torque")

    def command(self, position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """See ``Arm``."""
        frames, n = self._targets(position), self._model.count
        self._send(frames)
        return np.array([*unpack([data for _, data in frames[1:-1]], n), *position[n:]])

    def close(self) -> None:
        """See ``Arm``: the motors stay on."""
        self._bus.shutdown()


def of(kind: str, metadata: Mapping[str, Any], clock: Clock, port: str | None, **_: Any) -> Agilex:
    """Makes the driver of the arm at a port."""
    assert port
    return Agilex(MODELS[kind], metadata, port, clock)
