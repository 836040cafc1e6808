"""Any arm that LeRobot drives, through LeRobot's ``Robot`` (huggingface/lerobot, ``src/lerobot/robots/robot.py``).

``--port TYPE:field=value,...`` is LeRobot's configuration, such as ``so101_follower:port=/dev/ttyACM0,id=mine``. Packages named
``lerobot_robot_*`` are found as LeRobot finds them. ``get_observation`` and ``send_action`` use ``MOTOR.pos`` in degrees, or for
a gripper from 0 (closed) to 100 (open). If an arm differs, ``--calibration`` is a JSON file with an entry per joint:

    {"joint1": {"motor": "shoulder", "scale": 0.017453, "offset": 0.0}}      position = scale * (MOTOR.pos) + offset [rad or m]

``disconnect`` is never called, because it can switch torque off. Some of LeRobot's robots switch torque off for a moment in
``connect``, so support the arm.
"""

import contextlib
import dataclasses
import math
import pathlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from mjx_nero import files
from mjx_nero.deploy.arm import ArmError, Clock, Feedback
from mjx_nero.errors import UserError


@dataclasses.dataclass(frozen=True)
class Motor:
    """A joint's motor: ``position = scale * (MOTOR.pos) + offset`` [rad or m]."""

    motor: str
    scale: float
    offset: float


def motors_of(metadata: Mapping[str, Any], path: pathlib.Path | None) -> list[Motor]:
    """Returns the joints' motors, from a calibration file or by LeRobot's conventions.

    Raises:
        UserError: the file does not exist, or is invalid.
    """
    own = metadata["joints"]
    if path is None:
        out = []
        for name, low, high in zip(own["names"], own["lower"], own["upper"], strict=True):
            grips = name in metadata["gripper"]
            out.append(Motor(name, (high - low) / 100, low) if grips else Motor(name, math.pi / 180, 0.0))
        return out
    found = files.read_json(path)
    try:
        made = [Motor(str(found[j]["motor"]), float(found[j]["scale"]), float(found[j]["offset"])) for j in own["names"]]
    except (ValueError, TypeError, KeyError):
        raise UserError(f"{path} needs motor, scale and offset for each of {', '.join(own['names'])}") from None
    if not all(math.isfinite(m.scale) and math.isfinite(m.offset) and m.scale for m in made):
        raise UserError(f"{path}: scale takes a finite number other than 0, and offset a finite number")
    return made


class LeRobotArm:
    """One of LeRobot's robots.

    Args:
        robot: has ``connect``, ``get_observation``, ``send_action``, ``disconnect`` and ``is_connected``.
    """

    def __init__(self, metadata: Mapping[str, Any], robot: Any, motors: list[Motor], clock: Clock):
        self.joints = tuple(metadata["joints"]["names"])
        self._robot, self._clock = robot, clock
        self._keys = [f"{motor.motor}.pos" for motor in motors]
        self._scale, self._offset = (np.array([getattr(m, name) for m in motors]) for name in ("scale", "offset"))
        self._last: tuple[float, np.ndarray] | None = None
        with contextlib.suppress(AttributeError):
            robot.config.disable_torque_on_disconnect = False
        robot.disconnect = lambda: None  # its destructor also calls it

    def ranges(self) -> None:
        """See ``Arm``: LeRobot does not report them."""

    def connect(self) -> None:
        """See ``Arm``."""
        known = {*self._robot.action_features, *self._robot.observation_features}
        if missing := [key for key in self._keys if key not in known]:
            raise UserError(
                f"the robot has no {', '.join(missing)}, it has {', '.join(sorted(map(str, self._robot.action_features)))}: "
                "pass --calibration with the motor of each joint"
            )
        try:
            if not self._robot.is_connected:
                self._robot.connect(calibrate=False)
        except Exception as error:  # each robot has its own kinds
            raise UserError(f"LeRobot cannot connect: {error}") from None

    def engage(self) -> None:
        """See ``Arm``: sends the present position as the target."""
        self.command(self.read().position, np.zeros(len(self.joints)))

    def read(self) -> Feedback:
        """See ``Arm``: velocities are differences."""
        try:
            seen = self._robot.get_observation()
            at = np.array([float(seen[key]) for key in self._keys]) * self._scale + self._offset
        except Exception as error:
            raise ArmError(f"LeRobot cannot read the arm: {error}") from None
        now = self._clock.now()
        before, self._last = self._last, (now, at)
        passed = now - before[0] if before else 0.0
        return Feedback(now, at, (at - before[1]) / passed if before and passed > 0 else np.zeros(len(at)))

    def command(self, position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """See ``Arm``."""
        values = (position - self._offset) / self._scale
        try:
            sent = self._robot.send_action(dict(zip(self._keys, values.tolist(), strict=True)))
            return np.array([float(sent[key]) for key in self._keys]) * self._scale + self._offset
        except Exception as error:
            raise ArmError(f"LeRobot cannot move the arm: {error}") from None

    def close(self) -> None:
        """See ``Arm``: the arm stays connected, with torque on, until this process ends."""


def of(metadata: Mapping[str, Any], clock: Clock, port: str | None, calibration: str | None, **_: Any) -> LeRobotArm:
    """Makes the robot that ``TYPE:field=value,...`` describes.

    Raises:
        UserError: LeRobot has no such robot.
    """
    assert port
    from lerobot.robots import make_robot_from_config
    from lerobot.robots.config import RobotConfig
    from lerobot.utils.import_utils import register_third_party_plugins

    register_third_party_plugins()
    kind, rest = (port.partition(":")[k] for k in (0, 2))
    fields = dict(part.split("=", 1) for part in rest.split(",") if "=" in part)
    try:
        robot = make_robot_from_config(RobotConfig.get_choice_class(kind)(**fields))
    except Exception as error:
        raise UserError(f"LeRobot has no robot {port!r}: {error}") from None
    return LeRobotArm(metadata, robot, motors_of(metadata, pathlib.Path(calibration) if calibration else None), clock)
