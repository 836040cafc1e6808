"""Emulated STS3215 servos behind a serial line: registers in EEPROM and RAM, and answers at the real bus's pace.

It counts what a runtime must never do: ``eeprom_writes`` and ``torque_cuts``.
"""

import dataclasses
import json
import pathlib
import random
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from mjx_nero.deploy.drivers import feetech
from mjx_nero.deploy.emulators.line import Line
from mjx_nero.deploy.emulators.plant import Plant

_EEPROM_END, _FACTORY = 40, 80
_GEARS = 100.0  # [N m s/rad]: gears of 1:345, so that an arm without power sinks slowly
_BYTE = 1e-5  # time of a byte at 1 Mbaud [s]
_REFRESH = 0.02  # time between updates of the measurements without requests [s]


@dataclasses.dataclass
class BusFaults:
    """Faults of the bus, which can be set while it runs.

    Attributes:
        cut: no byte passes in either direction.
        corrupt: share of answers with a flipped bit.
        frozen: measurements in the registers no longer change.
        turnaround: time until each answer [s]; for six servos this makes the 5 to 6 ms that a read of all joints takes.
        hiccup, hiccup_s: share of requests that are answered late, and by how much [s].
        errors: error bits that servos report, by id.
        heat: temperature of the servos [degrees C].
    """

    cut: bool = False
    corrupt: float = 0.0
    frozen: bool = False
    turnaround: float = 8e-4
    hiccup: float = 0.0
    hiccup_s: float = 0.04
    errors: Mapping[int, int] = dataclasses.field(default_factory=dict)
    heat: int = 35


class Servos:
    """The servos of an arm; ``answer`` handles a request's bytes.

    Args:
        calibration: LeRobot's calibration of each joint, in the plant's order.
        limits: limits of the plant's joints [n, 2] [rad].
        grips: which joints are the gripper's.
        middle: position of each joint at the middle of its calibrated range [rad].

    Attributes:
        faults: faults of the bus.
        eeprom_writes, torque_cuts: counts of forbidden actions.
    """

    def __init__(
        self, plant: Plant, calibration: Sequence[Mapping[str, int]], limits: np.ndarray, grips: np.ndarray, middle: np.ndarray
    ):
        self.plant, self.faults, self.eeprom_writes, self.torque_cuts = plant, BusFaults(), 0, 0
        self._calibration, self._limits, self._grips, self._middle = list(calibration), limits, grips, middle
        self._random = random.Random(0)
        self.memory = {entry["id"]: bytearray(100) for entry in self._calibration}
        for entry in self._calibration:
            known = {
                "model": feetech.MODEL,
                "id": entry["id"],
                "min_position": entry["range_min"],
                "max_position": entry["range_max"],
            }
            known |= {"max_torque": 1000, "torque_limit": 1000, "p": 16, "d": 32, "i": 0, "protection_current": 500, "lock": 1}
            for name, value in {**known, "homing_offset": entry["homing_offset"], "voltage": 120, "overload_torque": 80}.items():
                self._put(entry["id"], name, value)
        self.plant.powered[:], self.plant.gears = False, _GEARS
        self.plant.stiffen()
        self.refresh()
        for entry in self._calibration:
            self._put(entry["id"], "goal_position", self._get(entry["id"], "position"))

    def _put(self, servo: int, name: str, value: int) -> None:
        at, size = feetech.REGISTERS[name]
        self.memory[servo][at : at + size] = feetech.encode(name, value)

    def _get(self, servo: int, name: str) -> int:
        at, size = feetech.REGISTERS[name]
        return feetech.decode(name, bytes(self.memory[servo][at : at + size]))

    def _span(self, i: int) -> tuple[float, float]:
        """Returns counts per radian, and the count at the joint's zero."""
        entry, (low, high) = self._calibration[i], self._limits[i]
        first, last = entry["range_min"], entry["range_max"]
        if self._grips[i]:
            scale = (last - first) / (high - low)
            return scale, first - low * scale
        scale = 4095 / (2 * np.pi)
        return scale, (first + last) / 2 - self._middle[i] * scale

    def refresh(self) -> None:
        """Updates the servos' measurements."""
        self.plant.advance()
        if self.faults.frozen:
            return
        state = zip(self._calibration, self.plant.position(), self.plant.velocity(), self.plant.load(), strict=True)
        for i, (entry, position, velocity, load) in enumerate(state):
            scale, zero = self._span(i)
            self._put(entry["id"], "position", int(np.clip(round(position * scale + zero), -32767, 32767)))
            self._put(entry["id"], "velocity", int(np.clip(round(velocity * scale), -32767, 32767)))
            self._put(entry["id"], "load", int(np.clip(round(1000 * load), -1000, 1000)))
            self._put(entry["id"], "temperature", self.faults.heat)

    def answer(self, request: bytes) -> bytes:
        """Returns the answer to a request; empty if the request is damaged or is a broadcast write."""
        body = request[2:-1]
        if len(body) < 3 or feetech.checksum(body) != request[-1] or self.faults.cut:
            return b""
        servo, instruction, parameters = body[0], body[2], bytes(body[3:])
        if instruction == feetech.SYNC_WRITE:
            at, size, rest = parameters[0], parameters[1], parameters[2:]
            for k in range(0, len(rest) - size, size + 1):
                self._write(rest[k], at, rest[k + 1 : k + 1 + size])
            self._aim()
            return b""
        if instruction == feetech.SYNC_READ:
            self.refresh()
            at, size, ids = parameters[0], parameters[1], parameters[2:]
            return b"".join(self._reply(i, bytes(self.memory[i][at : at + size])) for i in ids if i in self.memory)
        if servo not in self.memory:
            return b""
        if instruction == feetech.WRITE:
            self._write(servo, parameters[0], parameters[1:])
            self._aim()
            return self._reply(servo)
        self.refresh()
        return self._reply(
            servo, bytes(self.memory[servo][parameters[0] :][: parameters[1]]) if instruction == feetech.READ else b""
        )

    def _reply(self, servo: int, data: bytes = b"") -> bytes:
        out = bytearray(feetech.packet(servo, self.faults.errors.get(servo, 0), data))
        if self._random.random() < self.faults.corrupt:
            out[self._random.randrange(len(out))] ^= 1 << self._random.randrange(8)
        return bytes(out)

    def _write(self, servo: int, at: int, data: bytes) -> None:
        if servo not in self.memory:
            return
        if at < _EEPROM_END or at + len(data) > _FACTORY:
            self.eeprom_writes += 1
        self.memory[servo][at : at + len(data)] = data
        i = [entry["id"] for entry in self._calibration].index(servo)
        torque = bool(self._get(servo, "torque_enable"))
        self.torque_cuts += bool(self.plant.powered[i]) and not torque
        self.plant.powered[i] = torque

    def _aim(self) -> None:
        """Sets the drives' targets to the servos' goals."""
        self.plant.advance()
        goals = []
        for i, entry in enumerate(self._calibration):
            scale, zero = self._span(i)
            goal = min(max(self._get(entry["id"], "goal_position"), entry["range_min"]), entry["range_max"])
            goals.append((goal - zero) / scale)
        self.plant.target(np.array(goals))


class Port:
    """Servos at the other end of a line.

    Attributes:
        name: name of the port to open.
    """

    def __init__(self, servos: Servos, line: Line):
        self.servos, self.name, self._line, self._bytes = servos, line.name, line, b""
        self.close = line.close

    def serve(self, until: Callable[[], bool] = lambda: False, other: int | None = None) -> None:
        """Answers requests, until ``until`` returns True or the file descriptor ``other`` ends."""
        self._line.serve(lambda: self._take(self._line.read()), self.servos.refresh, _REFRESH, until, other)

    def _take(self, data: bytes) -> None:
        """Splits the received bytes into packets."""
        self._bytes += data
        while (start := self._bytes.find(b"\xff\xff")) >= 0:
            self._bytes = self._bytes[start:]
            if len(self._bytes) < 4 or len(self._bytes) < 4 + self._bytes[3]:
                return
            size = 4 + self._bytes[3]
            request, self._bytes = self._bytes[:size], self._bytes[size:]
            self._reply(request)

    def _reply(self, request: bytes) -> None:
        began = time.monotonic()
        out, faults = self.servos.answer(request), self.servos.faults
        if out:
            wait = faults.turnaround * max(1, out.count(b"\xff\xff")) + _BYTE * (len(request) + len(out))
            wait += faults.hiccup_s if random.random() < faults.hiccup else 0.0
            time.sleep(max(0.0, began + wait - time.monotonic()))
            self._line.write(out)


def calibration(metadata: Mapping[str, Any], kind: str) -> dict[str, dict[str, int]]:
    """Makes the calibration of an emulated arm, with the model's ranges and arbitrary offsets."""
    own, out = metadata["joints"], {}
    for i, name in enumerate(own["names"]):
        low, high = own["lower"][i], own["upper"][i]
        wide, grips = (high - low) * 4095 / (2 * np.pi), name in metadata["gripper"]
        if kind == "so101" and not grips:  # the middle is the model's zero, so the range is symmetric
            wide = 2 * max(-low, high) * 4095 / (2 * np.pi)
        first = max(0, round(2047 - wide / 2))
        last = 4094 - first
        out[name] = {"id": i + 1, "drive_mode": 0, "homing_offset": 137 * i - 300, "range_min": first, "range_max": last}
    return out


def servos_of(metadata: Mapping[str, Any], kind: str, entries: Mapping[str, Mapping[str, int]], plant: Plant) -> Servos:
    """Makes the servos of an arm in a plant."""
    own = metadata["joints"]
    limits = np.array([own["lower"], own["upper"]]).T
    grips = np.array([name in metadata["gripper"] for name in own["names"]])
    middle = limits.mean(axis=1) if kind == "so100" else np.zeros(len(limits))
    return Servos(plant, [entries[name] for name in own["names"]], limits, grips, middle)


def port_of(plant: Plant, told: Mapping[str, Any]) -> Port:
    """Makes the arm that ``emulators.started`` describes."""
    entries = json.loads(pathlib.Path(told["calibration"]).read_text())
    made = Port(servos_of(told["metadata"], told["kind"], entries, plant), Line())
    made.servos.faults = dataclasses.replace(made.servos.faults, **told.get("bus", {}))
    return made
