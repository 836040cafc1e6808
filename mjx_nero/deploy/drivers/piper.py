"""AgileX Piper over CAN, by python-can: the frames that the maker publishes (agilexrobotics/piper_sdk, ``piper_msgs/msg_v2``).

All numbers are big-endian. Targets go out in joint mode. Nothing here sends 0x150, whose resume drops the arm, and nothing
disables a motor.
"""

import struct
import time
from collections.abc import Mapping
from typing import Any

import numpy as np

from mjx_nero.deploy.arm import ArmError, Clock, Feedback
from mjx_nero.errors import UserError

BITRATE = 1_000_000
MODE, TARGETS, GRIPPER, ENABLE = 0x151, (0x155, 0x156, 0x157), 0x159, 0x471
STATUS, JOINTS, GRIPPED = 0x2A1, (0x2A5, 0x2A6, 0x2A7), 0x2A8
FAST, SLOW = tuple(range(0x251, 0x257)), tuple(range(0x261, 0x267))
MILLIDEGREE, MICROMETRE = np.pi / 180_000, 1e-6
BY_CAN, JOINT_MODE, FULL_SPEED = 1, 1, 100
ALL_MOTORS, ON = 7, 2
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
_WAIT = 2.0  # [s] for the first feedback, and for motors to be enabled


def target_frames(arm: np.ndarray, stroke: float) -> list[tuple[int, bytes]]:
    """Frames that send the six joints [rad] and the gripper's opening [m]."""
    counts = [int(x) for x in np.rint(arm / MILLIDEGREE)]
    pairs = [(frame, struct.pack(">ii", *counts[2 * k : 2 * k + 2])) for k, frame in enumerate(TARGETS)]
    mode = bytes([BY_CAN, JOINT_MODE, FULL_SPEED, 0, 0, 0, 0, 0])
    return [(MODE, mode), *pairs, (GRIPPER, struct.pack(">ihBB", round(stroke / MICROMETRE), GRIP, 1, 0))]


class Piper:
    """The arm on a CAN bus. Its two fingers move as one: their joints are half the opening each, with opposite signs.

    Args:
        port: ``INTERFACE:CHANNEL`` of python-can.
    """

    def __init__(self, metadata: Mapping[str, Any], port: str, clock: Clock):
        self.joints = tuple(metadata["joints"]["names"])
        self._port, self._clock = port, clock
        self._frames: dict[int, tuple[float, bytes]] = {}
        self._engaged = False

    def ranges(self) -> None:
        """See ``Arm``: the model's, which are the maker's."""

    def connect(self) -> None:
        """See ``Arm``."""
        import can  # python-can, of the extra ``deploy``

        interface, colon, channel = self._port.partition(":")
        if not colon or not channel:
            raise UserError(f"--port of a Piper is INTERFACE:CHANNEL, as in socketcan:can0, got {self._port!r}")
        options: dict[str, Any] = {"sleep_after_open": 0.1} if interface == "slcan" else {}
        try:
            self._bus = can.Bus(interface=interface, channel=channel, bitrate=BITRATE, **options)
        except (can.CanError, OSError, ValueError, TypeError) as error:
            raise UserError(f"cannot open {self._port}: {error}") from None
        self._error = can.CanError
        end = time.monotonic() + _WAIT
        while not all(frame in self._frames for frame in (STATUS, *JOINTS, GRIPPED, *FAST, *SLOW)):
            if time.monotonic() > end:
                raise UserError(f"no Piper is heard at {self._port}: is it powered, and is the bus up at 1 Mbit/s?")
            self._listen(0.05)

    def _listen(self, wait: float = 0.0) -> None:
        """Takes what has come."""
        try:
            for _ in range(2000):
                message = self._bus.recv(wait)
                if message is None:
                    return
                wait = 0.0
                if not message.is_extended_id and not message.is_error_frame and len(message.data) == 8:
                    self._frames[message.arbitration_id] = self._clock.now(), bytes(message.data)
        except (self._error, OSError, ValueError) as error:
            raise ArmError(f"the CAN bus fails: {error}") from None

    def _send(self, frames: list[tuple[int, bytes]]) -> None:
        import can

        try:
            for frame, data in frames:
                self._bus.send(can.Message(arbitration_id=frame, data=data, is_extended_id=False), timeout=0.02)
        except (self._error, OSError, ValueError) as error:
            raise ArmError(f"the CAN bus fails: {error}") from None

    def engage(self) -> None:
        """See ``Arm``: targets where the joints are, and only then motors on."""
        position = self.read_position()[1]
        self._send(target_frames(position[:6], position[6] - position[7]))
        end = time.monotonic() + _WAIT
        while not all(self._frames[frame][1][5] & ENABLED for frame in SLOW):
            if time.monotonic() > end:
                raise ArmError("the motors cannot be enabled")
            self._send([(ENABLE, bytes([ALL_MOTORS, ON, 0, 0, 0, 0, 0, 0]))])
            self._listen(0.02)
        self._send(target_frames(position[:6], position[6] - position[7]))
        self._engaged = True

    def read_position(self) -> tuple[float, np.ndarray]:
        """Returns when its oldest part arrived [s], and where the joints are [rad or m]."""
        frames = [self._frames[frame] for frame in (*JOINTS, GRIPPED)]
        arm = np.concatenate([struct.unpack(">ii", data) for _, data in frames[:3]]) * MILLIDEGREE
        half = struct.unpack(">i", frames[3][1][:4])[0] * MICROMETRE / 2
        return min(when for when, _ in frames), np.array([*arm, half, -half])

    def read(self) -> Feedback:
        """See ``Arm``: the newest of what the arm sends by itself, some 200 times a second."""
        self._listen()
        self._check()
        when, position = self.read_position()
        speeds = [struct.unpack(">h", self._frames[frame][1][:2])[0] / 1000 for frame in FAST]
        heat = [max(struct.unpack(">hb", self._frames[frame][1][2:5])) for frame in SLOW]
        return Feedback(when, position, np.array([*speeds, 0.0, 0.0]), None, np.array([*heat, 0.0, 0.0], float))

    def _check(self) -> None:
        """Checks what the arm reports about itself.

        Raises:
            ArmError: something is wrong.
        """
        if (status := self._frames[STATUS][1][1]) in ARM_ERRORS:
            raise ArmError(f"the arm reports {ARM_ERRORS[status]}")
        for joint, frame in enumerate(SLOW, 1):
            state = self._frames[frame][1][5]
            if said := [text for bit, text in ERRORS.items() if state & bit]:
                raise ArmError(f"joint {joint} reports {' and '.join(said)}")
            if self._engaged and not state & ENABLED:
                raise ArmError(f"joint {joint} has lost its torque")

    def command(self, position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """See ``Arm``."""
        frames = target_frames(position[:6], float(position[6] - position[7]))
        self._send(frames)
        counts = np.concatenate([struct.unpack(">ii", data) for _, data in frames[1:4]])
        return np.array([*(counts * MILLIDEGREE), *position[6:]])

    def close(self) -> None:
        """See ``Arm``: the motors stay on."""
        self._bus.shutdown()


def of(metadata: Mapping[str, Any], clock: Clock, port: str | None, **_: Any) -> Piper:
    """The arm at a port."""
    assert port
    return Piper(metadata, port, clock)
