"""AgileX's Piper and Nero over CAN, by python-can: the frames that the maker publishes.

Those of the Piper stand in agilexrobotics/piper_sdk (``piper_msgs/msg_v2``), those of the Nero in agilexrobotics/pyAgxArm
(``protocols/can_protocol``): they are the Piper's and a seventh joint's. All numbers are big-endian. Targets go out in joint
mode, whose frames are the same in all firmware of the Nero up to 1.20; its versions differ in torque mode, which nothing here
uses. Byte 6 of the mode, which switches the Nero's own messages on and off, is 0: they stay as they are. Nothing here sends
0x150, whose resume drops the arm, and nothing disables a motor.
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
    """The frames of one arm.

    Attributes:
        name: for messages.
        targets, joints: of all joints, two a frame: what they are to do, and where they are.
        fast, slow: of each joint: speeds, and the motor's state.
        everyone: the joint number that means all of them.
        hint: what to look at where nothing is heard.
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
_WAIT = 2.0  # [s] for the first feedback, and for motors to be enabled
_OPENING = 0.1  # [s] that a serial adapter takes


def pack(arm: np.ndarray) -> list[bytes]:
    """Angles [rad], two a frame; the last one may be alone."""
    counts = [int(x) for x in np.rint(arm / MILLIDEGREE)]
    return [struct.pack(">ii", *(counts[k : k + 2] + [0])[:2]) for k in range(0, len(counts), 2)]


def unpack(frames: list[bytes], count: int) -> np.ndarray:
    """The inverse of ``pack`` [rad]."""
    return np.concatenate([struct.unpack(">ii", data) for data in frames])[:count] * MILLIDEGREE


def target_frames(model: Model, arm: np.ndarray, stroke: float) -> list[tuple[int, bytes]]:
    """Frames that send the arm's joints [rad] and the gripper's opening [m]."""
    mode = bytes([BY_CAN, JOINT_MODE, FULL_SPEED, 0, 0, 0, 0, 0])
    grip = struct.pack(">ihBB", round(stroke / MICROMETRE), GRIP, 1, 0)
    return [(MODE, mode), *zip(model.targets, pack(arm), strict=True), (GRIPPER, grip)]


class Agilex:
    """The arm on a CAN bus. Its two fingers move as one: their joints are half the opening each, with opposite signs.

    Args:
        port: ``INTERFACE:CHANNEL`` of python-can.
    """

    def __init__(self, model: Model, metadata: Mapping[str, Any], port: str, clock: Clock):
        self.joints = tuple(metadata["joints"]["names"])
        self._model, self._port, self._clock = model, port, clock
        self._frames: dict[int, tuple[float, bytes]] = {}
        self._engaged = False

    def ranges(self) -> None:
        """See ``Arm``: the model's, which are the maker's."""

    def connect(self) -> None:
        """See ``Arm``."""
        import can  # python-can, of the extra ``deploy``

        interface, colon, channel = self._port.partition(":")
        if not colon or not channel:
            raise UserError(f"--port of a {self._model.name} is INTERFACE:CHANNEL, as in socketcan:can0, got {self._port!r}")
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
                raise UserError(f"no {model.name} is heard at {self._port}: {model.hint}")
            self._wait()

    def _wait(self) -> None:
        """Lets some frames come."""
        self._clock.sleep_until(self._clock.now() + 0.01)
        self._listen()

    def _listen(self) -> None:
        """Takes what has come."""
        try:
            for _ in range(2000):
                message = self._bus.recv(0.0)
                if message is None:
                    return
                if not message.is_extended_id and not message.is_error_frame and len(message.data) == 8:
                    self._frames[message.arbitration_id] = self._clock.now(), bytes(message.data)
        except (self._error, OSError, ValueError, LookupError) as error:  # a serial adapter's line that is cut short, too
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
        """See ``Arm``: targets where the joints are, and only then motors on."""
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
        """Returns when its oldest part arrived [s], and where the joints are [rad or m]."""
        frames = [self._frames[frame] for frame in (*self._model.joints, GRIPPED)]
        arm = unpack([data for _, data in frames[:-1]], self._model.count)
        half = struct.unpack(">i", frames[-1][1][:4])[0] * MICROMETRE / 2
        return min(when for when, _ in frames), np.array([*arm, half, -half])

    def read(self) -> Feedback:
        """See ``Arm``: the newest of what the arm sends by itself, some 200 times a second."""
        self._listen()
        self._check()
        when, position = self.read_position()
        speeds = [struct.unpack(">h", self._frames[frame][1][:2])[0] / 1000 for frame in self._model.fast]
        heat = [max(struct.unpack(">hb", self._frames[frame][1][2:5])) for frame in self._model.slow]
        return Feedback(when, position, np.array([*speeds, 0.0, 0.0]), None, np.array([*heat, 0.0, 0.0], float))

    def _check(self) -> None:
        """Checks what the arm reports about itself.

        Raises:
            ArmError: something is wrong.
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
    """The arm at a port."""
    assert port
    return Agilex(MODELS[kind], metadata, port, clock)
