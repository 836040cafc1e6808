"""An arm behind its safety layer and its log. The runtime talks only to this."""

import contextlib
import ctypes
import os
import time
from collections.abc import Iterator, Sequence
from typing import Protocol

import numpy as np

from mjx_nero.deploy.arm import Arm, ArmError, Clock, Feedback
from mjx_nero.deploy.log import Log
from mjx_nero.deploy.safety import Command, Fault, Safety

_PRIORITY = 10  # real-time priority, from 1 to 99
_LOCK = 1 | 2 | 4  # Linux's MCL_CURRENT, MCL_FUTURE, MCL_ONFAULT: memory in use is never swapped out


class WallClock:
    """The clock of ``time.monotonic``."""

    _SPIN = 5e-4  # time of busy waiting [s], because sleep ends up to some tenths of a millisecond late

    def now(self) -> float:
        """See ``Clock``."""
        return time.monotonic()

    def sleep_until(self, time_: float) -> None:
        """See ``Clock``."""
        if (left := time_ - time.monotonic() - self._SPIN) > 0:
            time.sleep(left)
        while time.monotonic() < time_:
            pass


@contextlib.contextmanager
def urgent() -> Iterator[None]:
    """Gives this thread and those that it starts real-time priority, and locks memory, if the system allows it."""
    with contextlib.ExitStack() as stack:
        with contextlib.suppress(OSError, AttributeError):
            before = os.sched_getscheduler(0), os.sched_getparam(0)
            os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(_PRIORITY))
            stack.callback(os.sched_setscheduler, 0, *before)
            system = ctypes.CDLL(None)
            if system.mlockall(_LOCK) == 0:
                stack.callback(system.munlockall)
        yield


class Guarded(Protocol):
    """The arm's interface for the loop; the arm is in this process or in a separate one.

    Attributes:
        fault: why the arm holds; None: it does not.
        sent: time of the last command [s].
    """

    fault: Fault | None
    sent: float

    def start(self, anywhere: bool = False) -> Feedback: ...
    def read(self) -> Feedback: ...
    def command(self, target: np.ndarray, notes: Sequence[float] = ()) -> Command: ...
    def hold(self, fault: Fault) -> None: ...
    def close(self) -> None: ...


class Guard:
    """An arm in this process.

    Attributes:
        log: log of everything read and sent; None: there is none.
    """

    log: Log | None = None

    def __init__(self, arm: Arm, safety: Safety, clock: Clock):
        self.arm, self.safety, self.clock = arm, safety, clock
        self.sent = 0.0
        self._last: Feedback | None = None

    @property
    def fault(self) -> Fault | None:
        """See ``Guarded``."""
        return self.safety.fault

    def start(self, anywhere: bool = False) -> Feedback:
        """Reads the arm and starts commanding it.

        Raises:
            UserError: the arm is far from home, or already at fault.
            ArmError: it does not answer.
        """
        self._last = feedback = self.arm.read()
        self.safety.begin(feedback, self.clock.now(), anywhere)
        return feedback

    def read(self) -> Feedback:
        """Returns the newest feedback, checked by the safety layer; the previous one if the bus fails."""
        assert self._last is not None, "start first"
        try:
            self._last = self.arm.read()
        except ArmError as error:
            self.safety.hold(Fault("bus", str(error)))
        self.safety.check(self._last, self.clock.now())
        if self.log:
            self.log.read(self._last)
        return self._last

    def command(self, target: np.ndarray, notes: Sequence[float] = ()) -> Command:
        """Sends the safe command nearest to a target [rad or m]; after a fault, commands that brake and hold.

        Args:
            notes: for the log: start and end of inference [s], and the action.
        """
        command = self.safety.step(target)
        told = command.position
        try:
            told = self.arm.command(command.position, command.velocity)
        except ArmError as error:
            self.safety.lost(Fault("bus", str(error)))
        self.sent = self.clock.now()
        if self.log:
            self.log.sent(self.sent, told, command, self.fault, notes)
        return command

    def hold(self, fault: Fault) -> None:
        """Makes the arm brake and hold from the next command on."""
        self.safety.hold(fault)

    def settle(self) -> None:
        """Brakes to rest, one command per control step."""
        self.hold(Fault("stop", "the end"))
        for _ in range(1000):
            due = self.clock.now() + self.safety.limits.dt
            self.command(self.safety.position)
            if self.safety.at_rest:
                return
            self.clock.sleep_until(due)

    def close(self) -> None:
        """Brakes to rest, and leaves the arm holding there."""
        if self._last is not None:
            self.settle()
        self.arm.close()
        if self.log:
            self.log.close()


class Dry:
    """An arm that is read but never commanded. From the first command on, it reports the commanded positions as its own.

    Args:
        say: called with each command as text.
    """

    def __init__(self, arm: Arm, say=print):
        self.arm, self.joints, self._say = arm, arm.joints, say
        self._at: tuple[np.ndarray, np.ndarray] | None = None

    def connect(self) -> None:
        """See ``Arm``; the drives stay as they are."""
        self.arm.connect()

    def ranges(self) -> tuple[np.ndarray, np.ndarray] | None:
        """See ``Arm``."""
        return self.arm.ranges()

    def engage(self) -> None:
        """Leaves the drives as they are."""

    def read(self) -> Feedback:
        """See ``Arm``."""
        seen = self.arm.read()
        return seen if self._at is None else Feedback(seen.time, *self._at, seen.load, seen.temperature)

    def command(self, position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """Shows what would be sent."""
        self._at = position.copy(), velocity.copy()
        self._say(" ".join(f"{name} {x:+.3f}" for name, x in zip(self.joints, position, strict=True)))
        return position

    def close(self) -> None:
        """See ``Arm``."""
        self.arm.close()
