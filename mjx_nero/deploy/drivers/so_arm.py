"""SO-ARM100 and SO-ARM101: Feetech servos with LeRobot's calibration file.

LeRobot counts a joint's degrees from the middle of its calibrated range, ``(raw - middle) * 360 / 4095``, and a gripper from 0
(closed) to 100 (open). For the SO-ARM101 that middle is the model's zero. The SO-ARM100's model has other zeros: its calibrated
middle is taken as the middle of the model's range.
"""

import dataclasses
import pathlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from mjx_nero import files
from mjx_nero.deploy.arm import ArmError, Clock, Feedback
from mjx_nero.deploy.drivers import feetech
from mjx_nero.errors import UserError

_TURN = 4095 / (2 * np.pi)  # counts per radian, as in LeRobot
_WAIT = 0.03  # time limit for an answer [s]
_GRIP = 500  # maximum torque of the gripper, of 1000, as in LeRobot
_USUAL = {"p": 16, "i": 0, "d": 32}  # gains of LeRobot's follower, for which the models' drives are made


@dataclasses.dataclass(frozen=True)
class Servo:
    """One joint's entry in the calibration file."""

    id: int
    homing_offset: int
    range_min: int
    range_max: int


def read_calibration(path: pathlib.Path, joints: tuple[str, ...]) -> dict[str, Servo]:
    """Reads LeRobot's calibration file.

    Raises:
        UserError: it does not exist, or is for another arm.
    """
    found = files.read_json(path)
    try:
        if missing := [name for name in joints if name not in found]:
            raise UserError(f"{path} has no joint {', '.join(missing)}: it has {', '.join(map(str, found))[:200]}")
        out = {name: Servo(*(_count(found[name][field]) for field in FIELDS)) for name in joints}
        driven = {name: _count(found[name].get("drive_mode", 0)) for name in joints}
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        if isinstance(error, UserError):
            raise
        raise UserError(f"{path} is not a calibration file of LeRobot: each joint needs {', '.join(FIELDS)}") from None
    for name, servo in out.items():
        if not 0 <= servo.range_min < servo.range_max <= 4095 or not 0 < servo.id < 254 or abs(servo.homing_offset) > 2047:
            raise UserError(f"{path}: {name} has no range within 0 to 4095, or no id within 1 to 253: calibrate it again")
        if driven[name]:
            raise UserError(f"{path}: {name} has a drive_mode other than 0, which is untested: calibrate it with drive_mode 0")
    if len({servo.id for servo in out.values()}) < len(out):
        raise UserError(f"{path}: two joints have the same id: calibrate the arm again")
    return out


FIELDS = ("id", "homing_offset", "range_min", "range_max")


def _count(value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise ValueError("a whole number")
    return value


class SoArm:
    """An arm of STS3215 servos. It writes only RAM: torque, acceleration, goals and the gripper's torque limit.

    Args:
        port: port of the ``feetech.Bus``.
    """

    def __init__(self, kind: str, metadata: Mapping[str, Any], servos: Mapping[str, Servo], port: str, clock: Clock):
        self.joints = tuple(metadata["joints"]["names"])
        self._port, self._clock, self._servos = port, clock, [servos[name] for name in self.joints]
        self.ids = [servo.id for servo in self._servos]
        low, high = (np.array(metadata["joints"][name], float) for name in ("lower", "upper"))
        first, last = (np.array([getattr(s, name) for s in self._servos], float) for name in ("range_min", "range_max"))
        self._grips = np.array([name in metadata["gripper"] for name in self.joints])
        middle = np.where(self._grips | (kind == "so100"), (low + high) / 2, 0.0)
        self._middle, self._zero = (first + last) / 2, middle
        self._scale = np.where(self._grips, (last - first) / (high - low), _TURN)  # counts per radian
        self._first, self._last = first, last
        self.notes: list[str] = []

    def ranges(self) -> tuple[np.ndarray, np.ndarray]:
        """Returns the joint limits of the calibration [rad]."""
        return self._radians(self._first), self._radians(self._last)

    def _radians(self, raw: np.ndarray) -> np.ndarray:
        return (raw - self._middle) / self._scale + self._zero

    def _raw(self, position: np.ndarray) -> np.ndarray:
        return np.clip(np.rint((position - self._zero) * self._scale + self._middle), self._first, self._last).astype(int)

    def connect(self) -> None:
        """See ``Arm``: also compares the servos' EEPROM with the calibration file."""
        import serial  # pyserial, of the extra ``deploy``

        try:
            port = serial.serial_for_url(self._port, feetech.BAUD, timeout=_WAIT, write_timeout=_WAIT, exclusive=True)
        except (serial.SerialException, ValueError, OSError) as error:
            raise UserError(f"cannot open {self._port}: {error}") from None
        self._bus = feetech.Bus(port)
        for name, servo in zip(self.joints, self._servos, strict=True):
            self._check(name, servo)

    def _check(self, name: str, servo: Servo) -> None:
        """Checks that a servo is the one in the calibration file.

        Raises:
            UserError: it is not.
        """
        try:
            model = self._bus.read(servo.id, "model")
        except ArmError as error:
            raise UserError(f"{name}: {error}: is the arm powered, and is {self._port} its port?") from None
        if model != feetech.MODEL:
            raise UserError(f"{name}: servo {servo.id} is a model {model}, not an STS3215 ({feetech.MODEL})")
        for register, wanted in (
            ("homing_offset", servo.homing_offset),
            ("min_position", servo.range_min),
            ("max_position", servo.range_max),
            ("mode", 0),
        ):
            if (found := self._bus.read(servo.id, register)) != wanted:
                raise UserError(
                    f"{name}: servo {servo.id} has {register} {found}, but the calibration file has {wanted}: the file is for "
                    "another arm, or LeRobot has not written it yet (run lerobot-calibrate)"
                )
        for register, usual in _USUAL.items():
            if (found := self._bus.read(servo.id, register)) != usual:
                self.notes.append(f"{name} has {register.upper()} {found}, LeRobot's followers {usual}")

    def engage(self) -> None:
        """See ``Arm``: sets each servo's goal to its present position before it switches torque on."""
        for servo, grips in zip(self._servos, self._grips, strict=True):
            here = self._bus.read(servo.id, "position")
            self._bus.write(servo.id, "acceleration", 254)  # no limit by the servo: targets are limited already
            if grips and self._bus.read(servo.id, "torque_limit") > _GRIP:
                self._bus.write(servo.id, "torque_limit", _GRIP)
            self._bus.write(servo.id, "goal_position", min(max(here, servo.range_min), servo.range_max))
            self._bus.write(servo.id, "torque_enable", 1)

    def read(self) -> Feedback:
        """See ``Arm``: reads all servos with one request."""
        blocks = self._bus.read_all(self.ids, *feetech.STATE)
        rows = [feetech.registers(blocks[i], ("position", "velocity", "load", "temperature")) for i in self.ids]
        raw, speed, load, heat = (np.array([row[name] for row in rows], float) for name in rows[0])
        return Feedback(self._clock.now(), self._radians(raw), speed / self._scale, load / 1000, heat)

    def command(self, position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """See ``Arm``: commands all servos with one request; they follow goals as stiffly as they can."""
        goals = self._raw(position)
        self._bus.write_all("goal_position", dict(zip(self.ids, goals.tolist(), strict=True)))
        return self._radians(goals)

    def close(self) -> None:
        """See ``Arm``: torque stays on."""
        self._bus.close()


def of(kind: str, metadata: Mapping[str, Any], clock: Clock, port: str | None, calibration: str | None, **_: Any) -> SoArm:
    """Makes the driver of the arm at a port.

    Raises:
        UserError: there is no calibration file, or it is invalid.
    """
    if not calibration:
        raise UserError(f"--arm {kind} needs --calibration: the arm's file written by lerobot-calibrate")
    assert port
    joints = tuple(metadata["joints"]["names"])
    return SoArm(kind, metadata, read_calibration(pathlib.Path(calibration), joints), port, clock)
