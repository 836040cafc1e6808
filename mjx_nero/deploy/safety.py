"""The layer between policy and driver: whatever comes in, what goes out is within every limit, and every fault ends in holding.

A command is a position and the velocity with which it goes on. The layer keeps one promise from step to step: from every
command the arm can brake, within its acceleration, to a rest that has been looked at already; all poses on that way are within
the joints' ranges and inside the fence. A target that would break the promise is bent to the nearest that does not, or the arm
brakes.
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
_SLOW = 0.05  # of a joint's speed: hardly a motion
_BENDS = 4  # tries to bend a target along the fence


@dataclasses.dataclass(frozen=True)
class SafetyCfg:
    """Limits beyond those of the joints.

    Attributes:
        share: of the joints' speeds.
        spin_up: from rest to full speed [s]: speed over acceleration.
        start: how far from home an arm's joint may be where a policy begins [rad or m].
        stale: feedback older than this is a fault [s].
        outside: how far beyond its range a joint may be read [rad or m].
        behind, behind_s: a joint that is so far from its command [rad or m] for so long [s] is stalled.
        load, load_s: a joint of the arm that hardly moves while its drive gives such a share of its torque, for so long [s], is
            blocked.
        temperature: of a drive, at most [degrees C].
        misses: so many deadlines in a row, missed, are a fault.
        silence: without a target for so long, the arm holds [s].
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
        arm: which of them are the arm's, the others being the gripper's, which is there to press and to be blocked.
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
            UserError: home is outside.
        """
        narrow = dataclasses.replace(self, lower=np.maximum(self.lower, lower), upper=np.minimum(self.upper, upper))
        for name, home, low, high in zip(self.names, self.home, narrow.lower, narrow.upper, strict=True):
            if not low - 1e-3 <= home <= high + 1e-3:
                raise UserError(
                    f"home of {name} is {home:.2f}, and the arm's own range is {low:.2f} to {high:.2f}: calibrate it again"
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
    """A command: where the joints must be [rad or m], the velocity there [rad/s or m/s], and which limits acted."""

    position: np.ndarray
    velocity: np.ndarray
    limited: tuple[str, ...] = ()


class Safety:
    """One arm's. ``begin`` it with the arm at rest; then ``check`` every feedback, and ``step`` every target.

    Attributes:
        position, velocity: of the last command.
        fault: the first one; from then on every command brakes, and then holds.
        counts: how often each limit acted.
        blocked_by: which of the fence's constraints bent a target last.
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
        self._passed = self.position  # where joints were last seen to move, or to need little torque
        self._pressing = np.zeros(len(self.position), bool)  # which joints push at something, and hold where they are
        self._met = self.position  # where they were read then
        self._clear: np.ndarray | None = None  # clearances at the last command

    def begin(self, feedback: Feedback, now: float, anywhere: bool = False) -> None:
        """Takes over an arm at rest.

        Args:
            anywhere: it may be far from home: it is to be moved there.

        Raises:
            UserError: it is far from home, or its feedback is at fault.
        """
        at = np.asarray(feedback.position, float)
        limits = self.limits
        self._seen = None
        if fault := self._fault(feedback, now):
            raise UserError(f"the arm cannot start: {fault.text}")
        self.position, self.velocity = at.copy(), np.zeros(len(at))  # beyond a range it may only go back
        self._clear = None
        far = np.abs(at - limits.home)[limits.arm]
        if not anywhere and far.max() > self.cfg.start:
            name = np.array(limits.names)[limits.arm][int(far.argmax())]
            raise UserError(
                f"the arm is far from home: {name} by {far.max():.2f}, and a policy begins within {self.cfg.start:.2f} "
                "[rad or m]: move it there slowly with --go-home"
            )
        self._seen = feedback

    def check(self, feedback: Feedback, now: float) -> Fault | None:
        """Looks at a feedback; a fault makes the arm hold, for good."""
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
        """The last command did not arrive: the drives are at the one before, and hold."""
        self.hold(fault)
        self.position, self.velocity, self._clear = self._before, np.zeros_like(self._before), None

    def step(self, target: np.ndarray) -> Command:
        """The next command towards a target [rad or m], or, after a fault, to rest."""
        target = np.asarray(target, float)
        if self.fault is None and (target.shape != self.position.shape or not np.all(np.isfinite(target))):
            self.hold(Fault("nan", "the policy's targets are not finite"))
        if self.fault is None:
            return self._move(target)
        if not np.any(self._pressing):
            return self._brake(())
        back = np.where(self._pressing, self._met - self.position, 0.0)  # a drive that goes on to press burns
        way = _stoppable(np.abs(back), self.limits.acceleration * self.limits.dt**2)
        return self._move(self.position + np.sign(back) * way)

    @property
    def at_rest(self) -> bool:
        """True if the last command stands still."""
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
        """Velocities of the next step: within acceleration and speed, and such that the arm can brake before its ranges."""
        limits = self.limits
        change, dt = limits.acceleration * limits.dt, limits.dt
        low = np.maximum(self.velocity - change, -limits.speed)
        high = np.minimum(self.velocity + change, limits.speed)
        up, down = (_stoppable(room, change * dt) / dt for room in (limits.upper - self.position, self.position - limits.lower))
        calm = self._braked(self.velocity)
        return np.minimum(np.maximum(low, -down), calm), np.maximum(np.minimum(high, up), calm)

    def _braked(self, velocity: np.ndarray, steps: Any = 1) -> np.ndarray:
        """A velocity after some steps of braking."""
        change = self.limits.acceleration * self.limits.dt
        return np.sign(velocity) * np.maximum(np.abs(velocity) - steps * change, 0.0)

    def _poses(self, velocity: np.ndarray) -> np.ndarray:
        """[k, n]: the next command, and all on the way to rest from there."""
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
        """Says what is wrong with a feedback, if anything."""
        limits, cfg, at = self.limits, self.cfg, np.asarray(feedback.position, float)
        speeds = np.asarray(feedback.velocity, float)
        if at.shape != limits.home.shape or not (np.all(np.isfinite(at)) and np.all(np.isfinite(speeds))):
            return Fault("nan", "the arm's feedback is not finite")
        if not now - feedback.time <= cfg.stale:
            return Fault("stale", f"the arm's feedback is {1e3 * (now - feedback.time):.0f} ms old")
        beyond = np.maximum(limits.lower - at, at - limits.upper)
        if beyond.max() > cfg.outside:
            return Fault("range", f"{self._name(beyond)} is read {beyond.max():.2f} beyond its range [rad or m]")
        if self._seen is not None:
            passed = max(feedback.time - self._seen.time, limits.dt)
            leap = np.abs(at - self._seen.position) - 4 * limits.speed / cfg.share * passed - 0.02
            if leap.max() > 0:
                return Fault("jump", f"{self._name(leap)} is read where it cannot have got to")
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
                return Fault("load", f"{self._name(np.where(pushing, load, 0.0))} is blocked: its drive gives all it has")
        return None

    def _name(self, values: np.ndarray) -> str:
        """Names the worst joint; only among the arm's if those matter."""
        return self.limits.names[int(np.argmax(values))]


class _Since:
    """Tracks for how long a condition has held, for each of several joints."""

    def __init__(self, count: int):
        self._begun = np.full(count, np.nan)

    def lasts(self, so: np.ndarray, now: float, seconds: float) -> np.ndarray:
        """True for those for which it has held for ``seconds``."""
        self._begun = np.where(so, np.where(np.isnan(self._begun), now, self._begun), np.nan)
        return np.asarray(now - self._begun >= seconds)


def _stoppable(room: np.ndarray, unit: np.ndarray) -> np.ndarray:
    """The longest step after which steps that shorten by ``unit`` each still end within ``room`` [rad or m]."""
    room = np.maximum(room, 0.0)
    count = np.maximum(np.ceil((np.sqrt(1 + 8 * room / unit) - 1) / 2 - 1e-12), 1)
    return room / count + unit * (count - 1) / 2
