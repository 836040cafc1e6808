"""Simulates logs of an arm for ``record``, with the noise, offsets and delays of a real one."""

import dataclasses
from typing import Annotated

import numpy as np

from mjx_nero.config import flag
from mjx_nero.config.bounds import Bounds, NonNegative, Positive, Seed, check
from mjx_nero.errors import UserError
from mjx_nero.identify.excitation import RATE, sweeps
from mjx_nero.identify.log import MAX_ROWS, Log
from mjx_nero.identify.plant import POSITIVE, Drives, Plant


@dataclasses.dataclass(frozen=True)
class RecordCfg:
    """Settings for recording a simulated arm.

    Attributes:
        seconds: length of the log [s].
        rate: rate of readings [Hz].
        noise: standard deviation of a reading [rad or m].
        resolution: one count of the encoders [rad or m]; 0: no rounding.
        scatter: multiply the model's parameters by log-uniform random factors up to this; 1: use the model's.
        offset: maximum offset of an encoder [rad or m].
        delay: delay of a target [s]; with a scatter above 1, the maximum of a random delay.
        amplitude: maximum amplitude of the movement [rad or m].
        seed: random seed.
    """

    seconds: Annotated[float, Bounds(0.0, 3600.0, above=True)] = flag(60.0)
    rate: Annotated[float, Bounds(1.0, 10_000.0)] = flag(200.0)
    noise: NonNegative = flag(0.0)
    resolution: NonNegative = flag(0.0)
    scatter: Annotated[float, Bounds(0.0, 100.0, above=True)] = flag(1.0)
    offset: NonNegative = flag(0.0)
    delay: Annotated[float, Bounds(0.0, 10.0)] = flag(0.0)
    amplitude: Positive = flag(0.5)
    seed: Seed = flag(0)

    def __post_init__(self):
        check(self)
        if self.seconds * self.rate > MAX_ROWS:
            raise UserError(f"{self.seconds:g} s at {self.rate:g} Hz are more than {MAX_ROWS:,} readings: pass less of one")


def record(plant: Plant, cfg: RecordCfg) -> tuple[Log, Drives]:
    """Simulates a log of the arm during ``excitation.sweeps``; returns it with the arm's true parameters.

    Raises:
        UserError: the arm has no room, or the simulation diverges.
    """
    rng, n = np.random.default_rng(cfg.seed), plant.n
    truth = draw(plant.nominal, cfg, rng)
    targets = sweeps(plant.robot, cfg.seconds, cfg.amplitude)
    sent, times = np.arange(len(targets)) / RATE, np.arange(round(cfg.seconds * cfg.rate)) / cfg.rate
    # The simulation begins with some time at rest before the log, as for a real one.
    (positions,) = plant.readings([truth], sent, targets, targets[0] + truth.offset, times)
    positions = positions + cfg.noise * rng.standard_normal((len(times), n))
    if cfg.resolution:
        positions = np.round(positions / cfg.resolution) * cfg.resolution
    return Log(sent, targets, times, positions), truth


def draw(nominal: Drives, cfg: RecordCfg, rng: np.random.Generator) -> Drives:
    """Draws parameters around the model's."""
    n, width = len(nominal.offset), abs(float(np.log(cfg.scatter)))
    factors = {name: getattr(nominal, name) * np.exp(rng.uniform(-width, width, n)) for name in POSITIVE}
    delay = cfg.delay * (rng.uniform() if width else 1.0)
    return Drives(**factors, offset=rng.uniform(-cfg.offset, cfg.offset, n), delay=delay)
