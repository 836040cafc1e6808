"""Emulated arms in this process, in simulated time, which runs as fast as the computer computes.

Registers, frames and drivers are the same as in the emulators with separate processes. Bytes take no time, and nothing waits.
"""

from collections.abc import Callable, Mapping
from typing import Any

from mjx_nero.deploy.arm import Arm
from mjx_nero.deploy.drivers import agilex, feetech, sim, so_arm
from mjx_nero.deploy.emulators import agilex as can
from mjx_nero.deploy.emulators import feetech as serial
from mjx_nero.deploy.emulators.plant import Plant
from mjx_nero.deploy.executor import Lag
from mjx_nero.deploy.places import Known, Place


class Clock:
    """Time that passes only while something waits. All of ``ticks`` is called every ``period`` [s]. See ``arm.Clock``."""

    def __init__(self, period: float = can.PERIOD):
        self.time, self.ticks, self._period, self._due = 100.0, list[Callable[[], Any]](), period, 100.0

    def now(self) -> float:
        """See ``arm.Clock``."""
        return self.time

    def sleep_until(self, time: float) -> None:
        """See ``arm.Clock``."""
        while self.ticks and self._due <= time:
            self.time = max(self.time, self._due)
            for tick in self.ticks:
                tick()
            self._due += self._period
        self.time = max(self.time, time)


class Wire:
    """A serial line that answers every request at once."""

    def __init__(self, servos: serial.Servos):
        self._servos, self._waiting = servos, b""

    def reset_input_buffer(self) -> None:
        """Discards received bytes."""
        self._waiting = b""

    def write(self, data: bytes) -> None:
        """Sends a request."""
        self._waiting += self._servos.answer(data)

    def read(self, count: int) -> bytes:
        """Returns up to ``count`` bytes of the answer."""
        out, self._waiting = self._waiting[:count], self._waiting[count:]
        return out

    def close(self) -> None:
        """Does nothing."""


class Sees(Known):
    """Object positions from the simulator.

    Attributes:
        plant: the simulator; set it before use.
    """

    plant: Plant

    def find(self, name: str, now: float) -> Place:
        """See ``Places``."""
        return Place(self.plant.place(name), self.plant.data.qpos[self.plant.objects[name] :][3:7].copy())


def _servos(told: Mapping[str, Any], plant: Plant, clock: Clock) -> tuple[Arm, Callable[[], None]]:
    entries = serial.calibration(told, "so101")
    known = {name: so_arm.Servo(**{f: entry[f] for f in so_arm.FIELDS}) for name, entry in entries.items()}
    arm = so_arm.SoArm("so101", told, known, "", clock)
    arm._bus = feetech.Bus(Wire(serial.servos_of(told, "so101", entries, plant)))
    return arm, lambda: None


def _frames(kind: str) -> Callable[[Mapping[str, Any], Plant, Clock], tuple[Arm, Callable[[], None]]]:
    def made(told: Mapping[str, Any], plant: Plant, clock: Clock) -> tuple[Arm, Callable[[], None]]:
        port = can.CanPort(can.Arm(plant, agilex.MODELS[kind]), f"virtual:{id(plant)}")
        clock.ticks = [port.take, port.say]
        arm = agilex.of(kind, told, clock, port.name)
        arm.connect()
        return arm, port.close

    return made


def _drives(told: Mapping[str, Any], plant: Plant, clock: Clock) -> tuple[Arm, Callable[[], None]]:
    return sim.SimArm(plant, tuple(told["joints"]["names"]), Lag.of(told).lead, clock), lambda: None


LINES = {"sim": _drives, "so101": _servos, "piper": _frames("piper"), "nero": _frames("nero")}


def engaged(kind: str, told: Mapping[str, Any], plant: Plant, clock: Clock) -> tuple[Arm, Callable[[], None]]:
    """Returns an arm that holds its position, and a function that unplugs it.

    Args:
        told: metadata of a policy, or of a robot.
    """
    arm, close = LINES[kind](told, plant, clock)
    arm.engage()

    def unplug() -> None:
        clock.ticks = []
        arm.close()
        close()

    return arm, unplug
