"""The safety layer between policy and driver. Whatever the policy sends, every command is within all limits, and every fault ends
in holding.

A command is a position and the velocity there. The layer maintains one invariant: from every command the arm can brake to rest
within its acceleration limit, through poses that were checked to be within the joint limits and inside the fence. A target that
would violate the invariant is bent to the nearest one that does not; otherwise the arm brakes.
"""

import collections
import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from mjx_nero.deploy.arm import Feedback
from mjx_nero.deploy.fence import Fence
from mjx_nero.errors import UserError

_EPS = 1e-9
_SLOW = 0.05  # share of a joint's speed that hardly counts as motion
_BENDS = 4  # maximum tries to bend a target along the fence


@dataclasses.dataclass(frozen=True)
class SafetyCfg:
    """Limits besides those of the joints.

    Attributes:
        share: share of the joints' speed limits.
        spin_up: time from rest to full speed [s]; sets the acceleration limit.
        start: maximum distance of an arm's joint from home when a policy begins [rad or m].
        stale: maximum age of feedback [s].
        outside: maximum reading beyond a joint's range [rad or m].
        behind, behind_s: a joint that is ``behind`` away from its command [rad or m] for ``behind_s`` [s] is stalled.
        load, load_s: an arm's joint that hardly moves while its drive gives more than the share ``load`` of its torque for
            ``load_s`` [s] is blocked.
        temperature: maximum temperature of a drive [degrees C].
        misses: number of missed deadlines in a row that is a fault.
        silence: time without a target after which the arm holds [s].
    """

    share: float = 1.0
    spin_up: float = 0.05
    start: float = 0.35
    stale: float = 0.1
    outside: float = 0.1
    behind: float = 0.3
    behind_s: float = 0.3
    load: float = 0.85
    load_s: float = 1.0
    temperature: float = 60.0
    misses: int = 5
    silence: float = 0.08


@dataclasses.dataclass(frozen=True)
class Limits:
    """Limits of the joints, as arrays along ``names`` [rad or m].

    Attributes:
        arm: which joints are the arm's. The others are the gripper's, which may press and be blocked.
    """

    names: tuple[str, ...]
    arm: np.ndarray
    home: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    speed: np.ndarray
    acceleration: np.ndarray
    dt: float

    @classmethod
    def of(cls, metadata: Mapping[str, Any], cfg: SafetyCfg) -> "Limits":
        """Reads the metadata of an exported policy."""
        own = metadata["joints"]
        home, lower, upper, speed = (np.array(own[name], float) for name in ("home", "lower", "upper", "speed"))
        speed = speed * cfg.share
        arm = np.array([name not in metadata["gripper"] for name in own["names"]])
        return cls(tuple(own["names"]), arm, home, lower, upper, speed, speed / cfg.spin_up, float(metadata["control_dt"]))

    def within(self, lower: np.ndarray, upper: np.ndarray) -> "Limits":
        """Narrows the ranges to those of an arm.

        Raises:
            UserError: home is outside these.
        """
        narrow = dataclasses.replace(self, lower=np.maximum(self.lower, lower), upper=np.minimum(self.upper, upper))
        for name, home, low, high in zip(self.names, self.home, narrow.lower, narrow.upper, strict=True):
            if not low - 1e-3 <= home <= high + 1e-3:
                raise UserError(
                    f"home of {name} is {home:.2f}, but the arm's own range is {low:.2f} to {high:.2f}: calibrate it again"
                )
        return dataclasses.replace(narrow, home=np.clip(self.home, narrow.lower, narrow.upper))


@dataclasses.dataclass(frozen=True)
class Fault:
    """The reason why an arm holds.

    Attributes:
        kind: ``nan``, ``stale``, ``bus``, ``range``, ``jump``, ``stall``, ``load``, ``temperature``, ``object``, ``picture``,
            ``deadline``, ``silence`` or ``stop``.
    """

    kind: str
    text: str


@dataclasses.dataclass(frozen=True)
class Command:
    """A command: positions of the joints [rad or m], velocities there [rad/s or m/s], and the limits that were reached."""

    position: np.ndarray
    velocity: np.ndarray
    limited: tuple[str, ...] = ()


class Safety:
    """The safety layer of one arm. Call ``begin`` with the arm at rest, then ``check`` every feedback and ``step`` every target.

    Attributes:
        position, velocity: of the last command.
        fault: the first fault; after it every command brakes, and then holds.
        counts: how often each limit was reached.
        blocked_by: the fence's constraint that last bent a target.
    """

    def __init__(self, limits: Limits, fence: Fence, cfg: SafetyCfg):
        self.limits, self.cfg, self._fence = limits, cfg, fence
        self.position = np.array(limits.home, float)
        self.velocity = np.zeros_like(self.position)
        self._before = self.position
        self.fault: Fault | None = None
        self.counts: collections.Counter[str] = collections.Counter()
        self.blocked_by = ""
        self._seen: Feedback | None = None
        self._since = {what: _Since(len(self.position)) for what in ("behind", "load")}
        self._passed = self.position  # positions at which joints last moved, or needed little torque
        self._pressing = np.zeros(len(self.position), bool)  # joints that push against something, and hold their position
        self._met = self.position  # their readings at that moment
        self._clear: np.ndarray | None = None  # clearances at the last command

    def begin(self, feedback: Feedback, now: float, anywhere: bool = False) -> None:
        """Takes over an arm at rest.

        Args:
            anywhere: the arm may be far from home, because it will be moved there.

        Raises:
            UserError: the arm is far from home, or its feedback is at fault.
        """
        at = np.asarray(feedback.position, float)
        limits = self.limits
        self._seen = None
        if fault := self._fault(feedback, now):
            raise UserError(f"the arm cannot start: {fault.text}")
        self.position, self.velocity = at.copy(), np.zeros(len(at))  # a joint beyond its range may only move back
        self._clear = None
        far = np.abs(at - limits.home)[limits.arm]
        if not anywhere and far.max() > self.cfg.start:
            name = np.array(limits.names)[limits.arm][int(far.argmax())]
            raise UserError(
                f"the arm is far from home: {name} by {far.max():.2f} [rad or m], a policy begins within {self.cfg.start:.2f}: "
                "move it home slowly with --go-home"
            )
        self._seen = feedback

    def check(self, feedback: Feedback, now: float) -> Fault | None:
        """Checks a feedback. A fault makes the arm hold for good."""
        if self.fault is None and (fault := self._fault(feedback, now)):
            self.hold(fault)
            self._met = np.asarray(feedback.position, float)
        if np.all(np.isfinite(feedback.position)):
            self._seen = feedback
        return self.fault

    def hold(self, fault: Fault) -> None:
        """Makes the arm brake and hold from now on. The first fault stays."""
        self.fault = self.fault or fault

    def lost(self, fault: Fault) -> None:
        """Handles a command that did not arrive: the drives still hold the one before."""
        self.hold(fault)
        self.position, self.velocity, self._clear = self._before, np.zeros_like(self._before), None

    def step(self, target: np.ndarray) -> Command:
        """Computes the next command towards a target [rad or m] or, after a fault, to rest."""
        target = np.asarray(target, float)
        if self.fault is None and (target.shape != self.position.shape or not np.all(np.isfinite(target))):
            self.hold(Fault("nan", "the policy's targets are not finite"))
        if self.fault is None:
            return self._move(target)
        if not np.any(self._pressing):
            return self._brake(())
        back = np.where(self._pressing, self._met - self.position, 0.0)  # a drive that keeps pressing overheats
        way = _stoppable(np.abs(back), self.limits.acceleration * self.limits.dt**2)
        return self._move(self.position + np.sign(back) * way)

    @property
    def at_rest(self) -> bool:
        """Whether the last command has zero velocity."""
        return not np.any(self.velocity)

    def _move(self, target: np.ndarray) -> Command:
        low, high = self._reach()
        wanted = (target - self.position) / self.limits.dt
        velocity = np.clip(wanted, low, high)
        acted = ("joints",) if np.any(np.abs(wanted - velocity) * self.limits.dt > 1e-6) else ()
        if self._clear is None:
            self._clear = self._fence.clearance(self.position[None])[0]
        allowed = np.minimum(0.0, self._clear) - _EPS
        for _ in range(_BENDS):
            poses = self._poses(velocity)
            clear = self._fence.clearance(poses)
            short = allowed - clear
            pose, constraint = np.unravel_index(int(short.argmax()), short.shape)
            if short[pose, constraint] <= 0:
                return self._go(velocity, acted, clear[0])
            if "fence" not in acted:
                acted = (*acted, "fence")
                self.blocked_by = self._fence.names[constraint]
            slope = self._fence.gradient(poses[pose], int(constraint))
            away = slope * (short[pose, constraint] + 1e-5) / max(float(slope @ slope), 1e-6)
            velocity = np.clip(velocity + away / self.limits.dt, low, high)
        return self._brake(acted)

    def _reach(self) -> tuple[np.ndarray, np.ndarray]:
        """Bounds the next velocity by acceleration and speed, and such that the arm can brake within its ranges."""
        limits = self.limits
        change, dt = limits.acceleration * limits.dt, limits.dt
        low = np.maximum(self.velocity - change, -limits.speed)
        high = np.minimum(self.velocity + change, limits.speed)
        up, down = (_stoppable(room, change * dt) / dt for room in (limits.upper - self.position, self.position - limits.lower))
        calm = self._braked(self.velocity)
        return np.minimum(np.maximum(low, -down), calm), np.maximum(np.minimum(high, up), calm)

    def _braked(self, velocity: np.ndarray, steps: Any = 1) -> np.ndarray:
        """Computes a velocity after some steps of braking."""
        change = self.limits.acceleration * self.limits.dt
        return np.sign(velocity) * np.maximum(np.abs(velocity) - steps * change, 0.0)

    def _poses(self, velocity: np.ndarray) -> np.ndarray:
        """Computes the next command's pose, and all poses until rest from there [k, n]."""
        change = self.limits.acceleration * self.limits.dt
        count = math.ceil(float(np.max(np.abs(velocity) / change)) - 1e-6)
        path = self._braked(velocity, np.arange(max(count, 0) + 1)[:, None])
        return self.position + np.cumsum(path, axis=0) * self.limits.dt

    def _brake(self, acted: tuple[str, ...]) -> Command:
        return self._go(self._braked(self.velocity), acted)

    def _go(self, velocity: np.ndarray, acted: tuple[str, ...], clear: np.ndarray | None = None) -> Command:
        self._before = before = self.position
        self._clear = clear
        low, high = np.minimum(self.limits.lower, before), np.maximum(self.limits.upper, before)
        self.position = np.clip(before + velocity * self.limits.dt, low, high)
        self.velocity = (self.position - before) / self.limits.dt
        self.counts.update(acted)
        return Command(self.position.copy(), self.velocity.copy(), acted)

    def _fault(self, feedback: Feedback, now: float) -> Fault | None:
        """Returns the fault of a feedback; None if there is none."""
        limits, cfg, at = self.limits, self.cfg, np.asarray(feedback.position, float)
        speeds = np.asarray(feedback.velocity, float)
        if at.shape != limits.home.shape or not (np.all(np.isfinite(at)) and np.all(np.isfinite(speeds))):
            return Fault("nan", "the arm's feedback is not finite")
        if not now - feedback.time <= cfg.stale:
            return Fault("stale", f"the arm's feedback is {1e3 * (now - feedback.time):.0f} ms old")
        beyond = np.maximum(limits.lower - at, at - limits.upper)
        if beyond.max() > cfg.outside:
            return Fault("range", f"the reading of {self._name(beyond)} is {beyond.max():.2f} [rad or m] beyond its range")
        if self._seen is not None:
            passed = max(feedback.time - self._seen.time, limits.dt)
            leap = np.abs(at - self._seen.position) - 4 * limits.speed / cfg.share * passed - 0.02
            if leap.max() > 0:
                return Fault("jump", f"the reading of {self._name(leap)} jumped farther than it can move")
        if feedback.temperature is not None and not np.max(feedback.temperature) <= cfg.temperature:
            return Fault("temperature", f"{self._name(feedback.temperature)} has {np.max(feedback.temperature):.0f} degrees C")
        if self._seen is not None:
            behind = np.where(limits.arm, np.abs(at - self.position), 0.0)
            if np.any(lasting := self._since["behind"].lasts(behind > cfg.behind, now, cfg.behind_s)):
                self._pressing = lasting
                return Fault("stall", f"{self._name(behind)} does not follow its commands")
        if feedback.load is not None:
            load = np.where(limits.arm, np.abs(feedback.load), 0.0)
            moving = np.abs(at - self._passed) > _SLOW * limits.speed / cfg.share * cfg.load_s
            pushing = ~(load <= cfg.load) & ~moving
            self._passed = np.where(pushing, self._passed, at)
            if np.any(lasting := self._since["load"].lasts(pushing, now, cfg.load_s)):
                self._pressing = lasting
                return Fault("load", f"{self._name(np.where(pushing, load, 0.0))} is blocked: its drive is at its torque limit")
        return None

    def _name(self, values: np.ndarray) -> str:
        """Returns the name of the joint with the largest value."""
        return self.limits.names[int(np.argmax(values))]


class _Since:
    """Tracks for how long a condition has held, for each of several joints."""

    def __init__(self, count: int):
        self._begun = np.full(count, np.nan)

    def lasts(self, so: np.ndarray, now: float, seconds: float) -> np.ndarray:
        """Returns for which joints the condition ``so`` has held for ``seconds``."""
        self._begun = np.where(so, np.where(np.isnan(self._begun), now, self._begun), np.nan)
        return np.asarray(now - self._begun >= seconds)


def _stoppable(room: np.ndarray, unit: np.ndarray) -> np.ndarray:
    """Computes the longest step from which braking, by ``unit`` less per step, still ends within ``room`` [rad or m]."""
    room = np.maximum(room, 0.0)
    count = np.maximum(np.ceil((np.sqrt(1 + 8 * room / unit) - 1) / 2 - 1e-12), 1)
    return room / count + unit * (count - 1) / 2
