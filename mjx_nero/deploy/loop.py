"""The control loop, which turns feedback into safe commands at the policy's rate, and its timing."""

import collections
import dataclasses
import gc
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from mjx_nero.deploy import setup
from mjx_nero.deploy.arm import Clock, Feedback
from mjx_nero.deploy.executor import Joints, Lag
from mjx_nero.deploy.guard import Guarded
from mjx_nero.deploy.lateness import MOST, Lateness
from mjx_nero.deploy.observe import Observer
from mjx_nero.deploy.places import Everywhere, Lost
from mjx_nero.deploy.policy import Policy
from mjx_nero.deploy.safety import Fault
from mjx_nero.errors import UserError

Stop = Callable[[], Fault | None]
_SOMEWHERE = [0.3, 0.0, 0.3]  # a goal [m]
_HOMEWARD = 0.2  # maximum share of the joints' speeds on the way home
_PATIENCE = 2.0  # maximum time without progress on the way home [s]


class Brain(Policy):
    """A policy with its observations, its action chain and its drives' lag: turns feedback into intended joint positions."""

    def warm(self) -> None:
        """Makes one step at home, without an arm: the first one takes much longer, and shows whether the metadata are whole.

        Raises:
            UserError: the metadata are not what ``export`` writes, or need what no arm has.
        """
        try:
            with np.errstate(all="ignore"):
                body, home = setup.body_of(self.metadata), Joints.of(self.metadata).home
                pictures = {name: np.zeros(shape, np.uint8) for name, shape in self.cameras.items()}
                observer = Observer(self.metadata, body, _SOMEWHERE, Everywhere(), lambda *_: pictures)
                feedback = Feedback(0.0, home, np.zeros_like(home))
                self.begin(observer, feedback)
                first, room = self(feedback, 0.0), setup.room_for(self.metadata, body, 0.0)
            if not (np.isfinite(first).all() and np.isfinite(room).all()):
                raise ValueError("they lead to numbers that are not finite")
        except UserError:
            raise
        except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
            what = " ".join(f"{type(error).__name__}: {error}".split())
            raise UserError(f"the policy's metadata are not what export writes ({what}): export the policy again") from None
        gc.collect()

    def begin(self, observer: Observer, feedback: Feedback, delay: float | None = None) -> None:
        """Starts a new episode from the joints' positions.

        Args:
            delay: time from sending a target until it takes effect [s]; the policy observes the targets that are in effect. None:
                it is measured while the arm moves.
        """
        self.reset()
        self._observer, self._lag = observer, Lag.of(self.metadata)
        self._executor = self.executor(feedback.position)
        self.action = np.zeros(len(self._executor.home_action))
        self._meant = np.array(feedback.position, float)
        self._late = None if delay is None else round(delay / float(self.metadata["control_dt"]))
        past = 1 + (MOST if self._late is None else self._late)
        self._targets = collections.deque([self._meant] * past, maxlen=past)
        grips = self.metadata["gripper"]
        self.lateness = Lateness(np.array([name not in grips for name in self.metadata["joints"]["names"]]))

    def __call__(self, feedback: Feedback, now: float) -> np.ndarray:
        """Computes where the joints must be next [rad or m].

        Raises:
            ValueError: an object is lost, a picture is old, or an observation or the action is not finite.
        """
        self._targets.append(self._executor.last)
        found = self.lateness(feedback.position, self._meant)
        late = found if self._late is None else self._late
        seen = self._observer(feedback, self._targets[-1 - late], self.action, now)
        action = np.asarray(self.act(seen, self._observer.pictures(feedback, now)), float)
        if not np.all(np.isfinite(action)):
            raise ValueError("the policy's action is not finite")
        self.action = action
        return self._lag(self._executor(self.action, feedback.position), self._meant)

    def sent(self, position: np.ndarray) -> None:
        """Stores the safety layer's command, from which the joints continue."""
        self._meant = position


@dataclasses.dataclass
class Timing:
    """Durations of cycles [s]; ``missed``: late cycles, and by how much they were late [s]."""

    jitter: list[float] = dataclasses.field(default_factory=list)
    read: list[float] = dataclasses.field(default_factory=list)
    infer: list[float] = dataclasses.field(default_factory=list)
    send: list[float] = dataclasses.field(default_factory=list)
    missed: list[tuple[int, float]] = dataclasses.field(default_factory=list)

    def summary(self) -> dict[str, float]:
        """Computes medians and 99th percentiles [ms], and counts."""
        out: dict[str, float] = {"cycles": len(self.jitter), "missed": len(self.missed)}
        for name in ("jitter", "read", "infer", "send"):
            values = getattr(self, name)
            if values:
                out |= {f"{name}_p{p}_ms": round(1e3 * float(np.percentile(values, p)), 3) for p in (50, 99)}
        return out


@dataclasses.dataclass(frozen=True)
class Report:
    """The end of a run. ``fault``: why the arm holds; the end of the run's time also counts as a fault."""

    fault: Fault
    timing: Timing
    limited: Mapping[str, int]


def run(
    arm: Guarded,
    brain: Brain,
    observer: Observer,
    clock: Clock,
    seconds: float,
    stop: Stop,
    misses: int = 5,
    delay: float | None = None,
) -> Report:
    """Runs a policy until its time is over, ``stop`` ends it, or something fails. Then the arm holds.

    Args:
        seconds: maximum time [s].
        stop: called every cycle; a returned fault ends the run.
        misses: number of late cycles in a row that also ends the run.
        delay: delay of the arm's targets [s], see ``Brain.begin``.
    """
    dt = float(brain.metadata["control_dt"])
    gc.disable()  # a collection takes longer than the allowed jitter
    brain.begin(observer, arm.read(), delay)
    timing, limited, late, k, done = Timing(), dict[str, int](), 0, 0, Fault("stop", f"{seconds:g} s are over")
    begun = clock.now()
    try:
        while arm.fault is None:
            due = begun + k * dt
            clock.sleep_until(due)
            if ending := stop() or (done if k * dt >= seconds else None):
                arm.hold(ending)
                break
            for name in _cycle(arm, brain, clock, due, timing):
                limited[name] = limited.get(name, 0) + 1
            k += 1
            over = clock.now() - (begun + k * dt)
            late = late + 1 if over > 0 else 0
            if over > 0:
                timing.missed.append((k - 1, over))
                k += int(over / dt)  # skip the cycles that were missed
            if late >= misses:
                arm.hold(Fault("deadline", f"{late} cycles in a row were late"))
    finally:
        gc.enable()
    return Report(arm.fault or done, timing, limited)


def _cycle(arm: Guarded, brain: Brain, clock: Clock, due: float, timing: Timing) -> tuple[str, ...]:
    """Makes one control step; returns the limits that were reached."""
    started = clock.now()
    feedback = arm.read()
    inferring = clock.now()
    try:
        target = brain(feedback, inferring)
    except ValueError as error:
        arm.hold(Fault(error.kind if isinstance(error, Lost) else "nan", str(error)))
        target = feedback.position
    inferred = clock.now()
    command = arm.command(target, (inferring, inferred, *brain.action))
    brain.sent(command.position)
    timing.jitter.append(started - due)
    timing.read.append(inferring - started)
    timing.infer.append(inferred - inferring)
    timing.send.append(clock.now() - inferred)
    return command.limited


def go_home(arm: Guarded, limits: Any, clock: Clock, stop: Stop) -> Fault | None:
    """Moves an arm home slowly, in a straight line in joint space.

    Args:
        limits: ``safety.Limits`` of the arm.

    Returns:
        why it stopped early; None: the arm is at home.
    """
    at, home, dt = arm.read().position, limits.home, limits.dt
    begun, moved = clock.now(), clock.now()
    k = 0
    while arm.fault is None:
        clock.sleep_until(begun + k * dt)
        k += 1
        if ending := stop():
            arm.hold(ending)
            break
        arm.read()
        way = home - at
        longest = float(np.max(np.abs(way) / (limits.speed * _HOMEWARD * dt)))
        there = arm.command(at + way / max(longest, 1.0)).position
        if np.max(np.abs(home - there)) < 1e-4:
            return arm.fault
        if np.max(np.abs(there - at)) > 1e-5:
            moved = clock.now()
        if clock.now() - moved > _PATIENCE:
            return Fault("fence", "the straight way home is blocked: move the arm by hand, or pass another --workspace")
        at = there
    return arm.fault
