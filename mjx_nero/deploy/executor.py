"""The action chain in numpy: turns a policy's actions into position targets of the drives.

This file needs only numpy. The chain is described by the JSON that ``mdp.actions`` terms write about themselves, and that
``export`` stores in an ONNX file. Each type in it is a class here. Tests check that both give the same targets at every step.
"""

import dataclasses
import reprlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np

MOST_JOINTS, MOST_PARTS = 1000, 100
LARGEST = 1e6  # largest number in a description


def numbers(found: Any, name: str, size: int | None = None, above: float = -np.inf) -> np.ndarray:
    """Reads a field of an untrusted description: finite numbers [size], or one for all.

    Args:
        size: required number of values; None: a single number.
        above: all values must be above this.

    Raises:
        ValueError: the field holds something else; one line.
    """
    value = found.get(name) if isinstance(found, Mapping) else None
    given = value if isinstance(value, list | tuple) else [value]
    plain = all(isinstance(x, int | float) and not isinstance(x, bool) and above < x and abs(x) <= LARGEST for x in given)
    if not plain or (isinstance(value, list | tuple) and len(value) != size):
        count = "a number" if size is None else f"{size} numbers, or one,"
        least = f" above {above:g}" if above > -np.inf else ""
        raise ValueError(f"the description's {name!r} takes {count}{least} up to {LARGEST:g}, got {reprlib.repr(value)}")
    return np.array(value, float)


def names(found: Any, name: str) -> tuple[str, ...]:
    """A field of a description that lists names, each once.

    Raises:
        ValueError: it does not; one line.
    """
    value = found.get(name) if isinstance(found, Mapping) else None
    if (
        not isinstance(value, list | tuple)
        or not all(isinstance(each, str) for each in value)
        or len(set(value)) < len(value)
        or len(value) > MOST_JOINTS
    ):
        raise ValueError(f"the description's {name!r} takes a list of names, each once, got {reprlib.repr(value)}")
    return tuple(value)


@dataclasses.dataclass(frozen=True)
class Joints:
    """The robot's joints, as arrays along ``names`` [rad or m].

    Attributes:
        speed: maximum speed of targets [rad/s or m/s].
        dt: control step [s].
    """

    names: tuple[str, ...]
    home: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    speed: np.ndarray
    dt: float

    @classmethod
    def of(cls, metadata: Mapping[str, Any]) -> "Joints":
        """Reads the metadata of an exported policy.

        Raises:
            ValueError: they are not an exported policy's; one line.
        """
        own = metadata.get("joints")
        called = names(own, "names")
        least = {"home": -np.inf, "lower": -np.inf, "upper": -np.inf, "speed": 0.0}
        arrays = {name: np.resize(numbers(own, name, len(called), above), len(called)) for name, above in least.items()}
        if not called or (arrays["lower"] > arrays["upper"]).any():
            raise ValueError("the description's 'joints' needs at least one, and 'lower' limits that are not above 'upper' ones")
        return cls(names=called, **arrays, dt=float(numbers(metadata, "control_dt", above=0.0)))

    def ids(self, wanted: Sequence[str]) -> np.ndarray:
        """Returns the indices of some joints in joint vectors.

        Raises:
            ValueError: a joint does not exist.
        """
        if unknown := [name for name in wanted if name not in self.names]:
            raise ValueError(f"no joint {reprlib.repr(unknown[0])}: not one of {', '.join(self.names)}"[:400])
        return np.array([self.names.index(name) for name in wanted], int)


@dataclasses.dataclass
class Step:
    """One action on its way to the drives."""

    action: np.ndarray  # the whole action
    position: np.ndarray  # positions of the joints
    last: np.ndarray  # present targets
    targets: np.ndarray  # new targets: home at first


class Part(Protocol):
    """A term of the chain. ``size``: number of entries of the action that it reads."""

    size: int

    def reset(self, position: np.ndarray, home_action: np.ndarray) -> None: ...
    def __call__(self, own: np.ndarray, step: Step) -> None: ...


class _Stateless:
    size = 0
    reads: tuple[str, ...] = ()  # fields of its description with a number for each joint, or one for all
    above_zero: tuple[str, ...] = ()  # further fields, with one number above 0

    def __init__(self, joints: Joints, what: Mapping[str, Any]):
        self.joints = joints
        key = "joints" if "joints" in what else "of"
        self.ids = joints.ids(names(what, key) if key in what else ())
        self.what = {name: numbers(what, name, len(self.ids)) for name in self.reads}
        self.what |= {name: numbers(what, name, above=0.0) for name in self.above_zero}

    def reset(self, position: np.ndarray, home_action: np.ndarray) -> None:
        """Does nothing: the part has no memory."""

    def home(self) -> np.ndarray:
        """Returns the entries that keep the robot at home."""
        return np.zeros(self.size)

    def bounded(self, values: np.ndarray) -> np.ndarray:
        """Clips to the ranges of the term's joints."""
        return np.clip(values, self.joints.lower[self.ids], self.joints.upper[self.ids])


class JointPosition(_Stateless):
    """``offset + scale * action``."""

    reads = ("offset", "scale")

    def __init__(self, joints: Joints, what: Mapping[str, Any]):
        super().__init__(joints, what)
        self.size = len(self.ids)
        if not np.all(self.what["scale"]):
            raise ValueError("the description's 'scale' of joint_position takes a number other than 0")

    def home(self) -> np.ndarray:
        """Returns zero, unless the offset is not home."""
        return (self.joints.home[self.ids] - self.what["offset"]) / self.what["scale"]

    def __call__(self, own: np.ndarray, step: Step) -> None:
        step.targets[self.ids] = self.bounded(self.what["offset"] + self.what["scale"] * own)


class JointVelocity(_Stateless):
    """Entries move set-points, which stay near the joints; targets lead the set-points."""

    reads, above_zero = ("ahead", "lag"), ("time",)

    def __init__(self, joints: Joints, what: Mapping[str, Any]):
        super().__init__(joints, what)
        self.size = len(self.ids)
        self.follow = 1 - np.exp(-joints.dt / what["time"])

    def reset(self, position: np.ndarray, home_action: np.ndarray) -> None:
        """Puts the set-points at the joints, at rest."""
        self.point, self.rate = position[self.ids], np.zeros(self.size)

    def __call__(self, own: np.ndarray, step: Step) -> None:
        speed, at = self.joints.speed[self.ids], step.position[self.ids]
        self.rate = self.rate + self.follow * (np.clip(own, -1, 1) - self.rate)
        most = speed * self.what["ahead"]
        self.point = self.bounded(np.clip(self.point + self.joints.dt * speed * self.rate, at - most, at + most))
        step.targets[self.ids] = self.bounded(self.point + self.what["lag"] * speed * self.rate)


class Binary(_Stateless):
    """A gripper: closes below ``-hysteresis``, opens from ``hysteresis`` on, and otherwise stays as it is; open at first."""

    size, reads = 1, ("close", "open")

    def __init__(self, joints: Joints, what: Mapping[str, Any]):
        super().__init__(joints, what)
        self.hysteresis = float(numbers({"hysteresis": 0.0, **what}, "hysteresis"))

    def reset(self, position: np.ndarray, home_action: np.ndarray) -> None:
        """Opens the gripper."""
        self.closed = False

    def __call__(self, own: np.ndarray, step: Step) -> None:
        self.closed = bool(own[0] < self.hysteresis * (1 if self.closed else -1))
        step.targets[self.ids] = self.bounded(self.what["close" if self.closed else "open"])


class Continuous(_Stateless):
    """A gripper: closed at -1, open at 1, and proportional in between."""

    size, reads = 1, ("close", "open")

    def home(self) -> np.ndarray:
        """Returns the entry for the gripper's opening at home."""
        close, open = (np.resize(self.what[end], len(self.ids)) for end in ("close", "open"))
        way = open - close
        return np.array([2 * ((self.joints.home[self.ids] - close) @ way) / (way @ way or 1.0) - 1])

    def __call__(self, own: np.ndarray, step: Step) -> None:
        close, share = self.what["close"], np.clip((1 + own[0]) / 2, 0, 1)
        step.targets[self.ids] = self.bounded(close + share * (self.what["open"] - close))


class AntiWindup(_Stateless):
    """Makes targets that reverse start near the joints."""

    reads = ("ahead",)

    def __call__(self, own: np.ndarray, step: Step) -> None:
        now, to, at = (values[self.ids] for values in (step.last, step.targets, step.position))
        most = self.what["ahead"] * self.joints.speed[self.ids]
        step.last[self.ids] = np.clip(np.clip(now, at - most, at + most), np.minimum(now, to), np.maximum(now, to))


class SpeedLimit(_Stateless):
    """Limits the speed of targets to that of their drives."""

    def __call__(self, own: np.ndarray, step: Step) -> None:
        most = self.joints.dt * self.joints.speed[self.ids]
        step.targets[self.ids] = step.last[self.ids] + np.clip(step.targets[self.ids] - step.last[self.ids], -most, most)


class LowPass(_Stateless):
    """A first-order filter of the action, for the parts after it."""

    above_zero = ("dt", "time")

    def reset(self, position: np.ndarray, home_action: np.ndarray) -> None:
        """Starts from the home action."""
        self.value = home_action

    def __call__(self, own: np.ndarray, step: Step) -> None:
        self.value = self.value + (1 - np.exp(-self.what["dt"] / self.what["time"])) * (step.action - self.value)
        step.action = self.value


class Nothing(_Stateless):
    """Does nothing, for terms that the real world adds by itself, such as delays and noise."""

    def __call__(self, own: np.ndarray, step: Step) -> None:
        """Changes nothing."""


PARTS: dict[str, Callable[[Joints, Mapping[str, Any]], Any]] = {
    "joint_position": JointPosition,
    "joint_velocity": JointVelocity,
    "binary": Binary,
    "continuous": Continuous,
    "anti_windup": AntiWindup,
    "speed_limit": SpeedLimit,
    "low_pass": LowPass,
    "delay": Nothing,
    "noise": Nothing,
}


class Executor:
    """Turns actions into targets, starting from the joints' positions.

    Args:
        joints: the robot's joints.
        parts: descriptions of the chain's terms, in order.
        position: first positions of the joints [rad or m].
        clip: actions are first clipped to +- this; 0: they are not clipped.

    Attributes:
        home_action: the action that keeps the robot at home.

    Raises:
        ValueError: a part has an unknown type, or its description is invalid.
    """

    def __init__(self, joints: Joints, parts: Sequence[Mapping[str, Any]], position: np.ndarray, clip: float = 0.0):
        if not isinstance(parts, list | tuple) or not 0 < len(parts) <= MOST_PARTS:
            raise ValueError(f"the description's 'actions' takes a list of up to {MOST_PARTS} parts, got {reprlib.repr(parts)}")
        if unknown := [kind for kind in map(_kind, parts) if kind not in PARTS]:
            raise ValueError(f"unknown type of action {reprlib.repr(unknown[0])}: not one of {', '.join(PARTS)}")
        self.joints, self.clip = joints, clip
        self._parts = [PARTS[part["type"]](joints, part) for part in parts]
        self._splits = np.cumsum([part.size for part in self._parts])[:-1]
        self.home_action = np.concatenate([part.home() for part in self._parts])
        self.reset(position)

    @classmethod
    def of(cls, metadata: Mapping[str, Any], position: np.ndarray) -> "Executor":
        """Makes the executor of an exported policy."""
        clip = {"action_clip": metadata.get("action_clip") or 0.0}
        return cls(Joints.of(metadata), metadata.get("actions", ()), position, float(numbers(clip, "action_clip")))

    def reset(self, position: np.ndarray) -> None:
        """Starts again, with targets at the joints' positions.

        Raises:
            ValueError: ``position`` is not one finite number per joint.
        """
        self.last = _finite(position, len(self.joints.names), "position").copy()
        for part in self._parts:
            part.reset(self.last.copy(), self.home_action)

    def __call__(self, action: np.ndarray, position: np.ndarray) -> np.ndarray:
        """Computes the targets for an action and the joints' positions, arrays along ``joints.names`` [rad or m].

        Raises:
            ValueError: one of them has another size or is not finite; such values never reach a drive.
        """
        action = _finite(action, len(self.home_action), "action")
        position = _finite(position, len(self.joints.names), "position")
        if self.clip:
            action = np.clip(action, -self.clip, self.clip)
        home = np.clip(self.joints.home, self.joints.lower, self.joints.upper)
        step = Step(action, position, self.last.copy(), home)
        for i, part in enumerate(self._parts):
            part(np.split(step.action, self._splits)[i], step)
        self.last = step.targets
        return self.last.copy()


class Lag:
    """Models the drives of training: joints follow targets like a first-order filter with time constant damping / stiffness.

    Its output is the intended positions of the joints. Limits apply to these, and arms with stiff drives receive them as targets.
    Drives like those of training receive ``position + lead * velocity``, which is the original target.

    Args:
        seconds: damping over stiffness of each joint [s].
        dt: control step [s].

    Attributes:
        lead: lead of targets over moving positions [s].
    """

    def __init__(self, seconds: np.ndarray, dt: float):
        self._share = 1 - np.exp(-dt / np.maximum(seconds, 1e-9))
        self.lead = dt / self._share - dt

    @classmethod
    def of(cls, metadata: Mapping[str, Any]) -> "Lag":
        """Makes the lag of an exported policy's drives."""
        joints = metadata["joints"]
        return cls(np.array(joints["damping"], float) / np.array(joints["stiffness"], float), float(metadata["control_dt"]))

    def __call__(self, target: np.ndarray, position: np.ndarray) -> np.ndarray:
        """Returns the intended positions after one step towards a target, from the present intended ones [rad or m]."""
        return position + self._share * (target - position)


def _kind(part: Any) -> Any:
    """Returns the type of a part; None if it has none."""
    kind = part.get("type") if isinstance(part, Mapping) else None
    return kind if isinstance(kind, str) else None


def _finite(value: Any, size: int, name: str) -> np.ndarray:
    array = np.asarray(value, float)
    if array.shape != (size,) or not np.isfinite(array).all():
        raise ValueError(f"{name} takes {size} finite numbers, got {reprlib.repr(value)}")
    return array
