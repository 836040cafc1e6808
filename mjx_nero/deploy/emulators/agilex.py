"""An emulated Piper or Nero behind a serial CAN adapter (SLCAN), which sends its frames 200 times per second.

It counts what a runtime must never do: ``torque_cuts``.
"""

import dataclasses
import struct
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from mjx_nero.deploy.drivers import agilex
from mjx_nero.deploy.emulators.line import Line
from mjx_nero.deploy.emulators.plant import Plant

_BRAKES = 1e4  # [N m s/rad]: without power the arm lies on something
PERIOD = 0.005  # time between feedbacks [s]
_WAY, _STEPS = 0.02, 8  # time to a new target [s]; steps on the way


@dataclasses.dataclass
class BusFaults:
    """Faults of the arm, which can be set while it runs.

    Attributes:
        cut: no frame passes in either direction.
        mute: frames that are not sent.
        status: the arm's status, in frame 0x2A1.
        bits: bits of each joint's state, by the joint's number from 1.
        heat: temperature of the motors [degrees C].
    """

    cut: bool = False
    mute: frozenset[int] = frozenset()
    status: int = 0
    bits: dict[int, int] = dataclasses.field(default_factory=dict)
    heat: int = 35


class Arm:
    """Handles frames as the arm does, and makes the frames that it sends by itself."""

    def __init__(self, plant: Plant, model: agilex.Model):
        self.plant, self.faults, self.torque_cuts, self._model = plant, BusFaults(), 0, model
        self._goal, self._told = plant.position(), plant.position()
        plant.powered[:], plant.gears = False, _BRAKES
        plant.stiffen()

    def take(self, frame: int, data: bytes) -> None:
        """Handles a frame from the runtime."""
        if self.faults.cut:
            return
        n = self._model.count
        if frame in self._model.targets and len(data) == 8:
            k = 2 * self._model.targets.index(frame)
            self._goal[k : min(k + 2, n)] = agilex.unpack([data], min(2, n - k))
        elif frame == agilex.GRIPPER and len(data) == 8:
            half = struct.unpack(">i", data[:4])[0] * agilex.MICROMETRE / 2
            self._goal[n:] = half, -half
            self._aim()
        elif frame == agilex.ENABLE and len(data) >= 2 and data[0] == self._model.everyone:
            on = data[1] == agilex.ON
            self.torque_cuts += bool(self.plant.powered.any()) and not on
            self.plant.powered[:] = on
            self._aim()
        elif frame == 0x150:  # stop and resume: the arm sinks
            self.torque_cuts += 1

    def _aim(self) -> None:
        """Moves straight to new targets. The real arm's planner is not known."""
        self.plant.advance()
        for k in range(1, _STEPS + 1):
            self.plant.target(self._told + (self._goal - self._told) * k / _STEPS, _WAY * k / _STEPS)
        self._told = self._goal.copy()

    def frames(self) -> list[tuple[int, bytes]]:
        """Makes all frames of one round of feedback."""
        self.plant.advance()
        if self.faults.cut:
            return []
        q, v, model, n = self.plant.position(), self.plant.velocity(), self._model, self._model.count
        out = [(agilex.STATUS, bytes([1, self.faults.status, 1, 0, 0, 0, 0, 0]))]
        out += zip(model.joints, agilex.pack(q[:n]), strict=True)
        out.append((agilex.GRIPPED, struct.pack(">ihBB", round((q[n] - q[n + 1]) / agilex.MICROMETRE), 0, 0x40, 0)))
        for k in range(n):
            speed = int(np.clip(round(1000 * v[k]), -32768, 32767))
            out.append((model.fast[k], struct.pack(">hHi", speed, 500, 0)))
            state = self.faults.bits.get(k + 1, 0) | (agilex.ENABLED if self.plant.powered[k] else 0)
            out.append((model.slow[k], struct.pack(">HhbBH", 240, self.faults.heat, self.faults.heat, state, 0)))
        return [(frame, data) for frame, data in out if frame not in self.faults.mute]


class CanPort:
    """The arm on one of python-can's buses, such as ``virtual:NAME`` within one process. Its owner calls ``take`` and ``say``.

    Attributes:
        name: the bus, for ``--port``.
    """

    def __init__(self, arm: Arm, name: str):
        import can

        self.arm, self.name, (interface, _, channel) = arm, name, name.partition(":")
        self._message, self._bus = can.Message, can.Bus(interface=interface, channel=channel)

    def take(self) -> None:
        """Handles all frames that have arrived."""
        while message := self._bus.recv(0.0):
            self.arm.take(message.arbitration_id, bytes(message.data))

    def say(self) -> None:
        """Sends one round of feedback."""
        for frame, data in self.arm.frames():
            self._bus.send(self._message(arbitration_id=frame, data=data, is_extended_id=False))

    def close(self) -> None:
        """Leaves the bus."""
        self._bus.shutdown()


class Port:
    """The serial adapter. A line of SLCAN is ``t``, three digits of the frame, its length, and its bytes in hexadecimal.

    Attributes:
        name: the port, for ``--port``.
    """

    def __init__(self, arm: Arm, line: Line):
        self.arm, self.name, self._line = arm, f"slcan:{line.name}", line
        self.close, self._bytes, self._left, self._open = line.close, b"", b"", False

    def serve(self, until: Callable[[], bool] = lambda: False, other: int | None = None) -> None:
        """Sends and handles frames, until ``until`` returns True or the file descriptor ``other`` ends."""
        self._line.serve(lambda: self._take(self._line.read()), self._say, PERIOD, until, other)

    def _take(self, data: bytes) -> None:
        *lines, self._bytes = (self._bytes + data).split(b"\r")
        self._bytes = self._bytes[-64:]
        for line in lines:
            if line[:1] in (b"O", b"C"):
                self._open = line[:1] == b"O"
            elif line[:1] == b"t" and self._open:
                try:
                    self.arm.take(int(line[1:4], 16), bytes.fromhex(line[5:].decode()))
                except ValueError:
                    continue

    def _say(self) -> None:
        """Sends one round of feedback. If nobody reads, whole frames are lost, as on a bus."""
        frames = self.arm.frames()
        if self._open and not self._left:
            self._left = "".join(f"t{frame:03X}{len(data)}{data.hex().upper()}\r" for frame, data in frames).encode()
        self._left = self._left[self._line.write(self._left) :]


def port_of(plant: Plant, told: Mapping[str, Any]) -> Port:
    """Makes the arm that ``emulators.started`` describes."""
    return Port(Arm(plant, agilex.MODELS[told["kind"]]), Line())
