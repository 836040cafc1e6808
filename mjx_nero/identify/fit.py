"""Fits the parameters of drives to a log by nonlinear least squares (SciPy) on MuJoCo's rollouts.

The log is simulated open loop from its first reading, and the differences to the readings are minimized: first over its start,
where a Jacobian is cheap, then over everything that is not held out. Drives that need short physics steps are searched in longer
ones first. Intervals follow from the Jacobian at the solution and the
residuals' variance, which is inflated by their correlation time, because what the model cannot explain is not independent noise.
They are wider by the error of the physics step, which half the step shows, and by a factor where readings are rounded more than
they are noisy. They know of no other error of the model.
"""

import dataclasses

import numpy as np
import scipy.linalg
import scipy.optimize
import scipy.special
from jaxtyping import Float

from mjx_nero.errors import UserError
from mjx_nero.identify.log import Log
from mjx_nero.identify.plant import USUAL, Drives, Plant

HELD_OUT = 0.25  # share of the log, at its end
_BEGINNING = 15.0  # length of the first part [s]
_SETTLED = 4.0  # time after which the positions in which dry friction held the joints no longer matter [s]
_SURE, _NOISE = 1.0, 1e-4  # prior: relative error of the model's own parameters, and noise of a reading [rad or m]
_FACTOR, _OFFSET, _LATEST = 30.0, 0.5, 0.3  # bounds: factor of the model's own parameters, offset [rad or m], delay [s]
_STEPS = 3e-4, 0.03  # finite difference of the search, in units of ``_unit``; the other one is for drives that oscillate
_WIDE = 0.1  # finite difference of the intervals; as joints stick and slip, smaller steps measure noise
_LEVEL = 0.975
_ALIKE = 6.0  # measured on emulated arms, see docs/guides/identification.md
_ENOUGH = 1e-5  # the search ends when a step reduces the sum by less than this share


@dataclasses.dataclass(frozen=True)
class Fit:
    """Identified drives.

    Attributes:
        drives, low, high: the values and their 95% intervals, if the arm follows the equation of ``plant``.
        readings: encoder readings of the identified arm [k, n] [rad or m].
        nominal: encoder readings with the model's own drives [k, n] [rad or m].
        held: where the log was held out [k].
        rms, nominal_rms: root mean squares of their differences to the held-out log [n] [rad or m].
    """

    drives: Drives
    low: Drives
    high: Drives
    readings: np.ndarray
    nominal: np.ndarray
    held: np.ndarray
    rms: np.ndarray
    nominal_rms: np.ndarray


def identify(plant: Plant, log: Log) -> Fit:
    """Fits drives to a log.

    Raises:
        UserError: the log does not determine all parameters, or the simulation diverges.
    """
    cut = log.times[0] + (1 - HELD_OUT) * (log.times[-1] - log.times[0])
    begun = dataclasses.replace(plant.nominal, offset=np.mean(log.positions - _held(log), axis=0))
    rough = plant if plant.dt >= USUAL else Plant(plant.robot, USUAL)
    part = (log.times >= log.times[0] + _SETTLED) & (log.times <= cut)
    x = _search(rough, log, part, dataclasses.replace(begun, delay=_first_delay(rough, log, begun)).vector())
    if rough is not plant:
        x = _solve(plant, log, part, x, _ENOUGH).x
    half = _half_widths(plant, log, part, x) * _alike(log, _read(plant, log, [x], part)[0] - log.positions[part])
    low, high = x - half, x + half
    low[: 4 * plant.n] = np.maximum(low, _unit(plant) / _FACTOR)[: 4 * plant.n]
    held, drives = log.times > cut, Drives.of(x)
    readings, nominal = _read(plant, log, [x, plant.nominal.vector()])
    rms, before = (np.sqrt(np.mean((path - log.positions)[held] ** 2, axis=0)) for path in (readings, nominal))
    return Fit(drives, Drives.of(low), Drives.of(high), readings, nominal, held, rms, before)


def _search(plant: Plant, log: Log, part: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Searches over the log's beginning, then over all of ``part``.

    Armatures have the least effect: the search can end where one is several times too large. So it starts again from there with
    the model's armatures, and the better of both solutions counts.
    """
    x = _solve(plant, log, part & (log.times <= log.times[0] + _BEGINNING), x, 0.03).x
    found = _solve(plant, log, part, x, _ENOUGH)
    x = np.concatenate([found.x[: 2 * plant.n], plant.nominal.armature, found.x[3 * plant.n :]])
    return min(found, _solve(plant, log, part, x, _ENOUGH), key=lambda solution: solution.cost).x


def _first_delay(plant: Plant, log: Log, drives: Drives) -> float:
    """Returns the delay [s] with which the model's drives fit the log's beginning best, to 10 ms.

    A search that begins far from it ends where damping and armature explain the delay.
    """
    part = (log.times >= log.times[0] + _SETTLED) & (log.times <= log.times[0] + _BEGINNING)
    tried = np.arange(0.0, 0.2, 0.01)
    paths = _read(plant, log, [dataclasses.replace(drives, delay=delay).vector() for delay in tried], part)
    return float(tried[int(np.argmin(((paths - log.positions[part]) ** 2).sum(axis=(1, 2))))])


def _held(log: Log) -> np.ndarray:
    """Returns the targets last sent before each reading [k, n]."""
    return log.targets[np.clip(np.searchsorted(log.sent, log.times, side="right") - 1, 0, None)]


def _read(plant: Plant, log: Log, vectors: list[np.ndarray], part: np.ndarray | None = None) -> Float[np.ndarray, "b k n"]:
    times = log.times if part is None else log.times[part]
    return plant.readings([Drives.of(x) for x in vectors], log.sent, log.targets, log.positions[0], times)


def _solve(plant: Plant, log: Log, part: np.ndarray, x: np.ndarray, enough: float):
    """Solves the least squares over a part of the log, with the model's own parameters as a weak prior.

    Args:
        enough: the search ends when a step reduces the sum by less than this share.
    """
    n, wanted, unit, step = plant.n, log.positions[part], _unit(plant), _STEPS[plant.oscillation > 0]
    guessed = np.eye(len(x))[: 4 * n] * _noise(log) / _SURE

    def residuals(z: np.ndarray) -> np.ndarray:
        return np.concatenate([(_read(plant, log, [z * unit], part)[0] - wanted).ravel(), guessed @ (z - 1)])

    def jacobian(z: np.ndarray) -> np.ndarray:
        here, *there = _read(plant, log, [z * unit, *((z + step * row) * unit for row in np.eye(len(z)))], part)
        return np.concatenate([np.stack([(path - here).ravel() for path in there], axis=1) / step, guessed])

    low, high = np.full(len(x), -_OFFSET / 0.01), np.full(len(x), _OFFSET / 0.01)
    low[: 4 * n], high[: 4 * n], low[-1], high[-1] = 1 / _FACTOR, _FACTOR, 0.0, _LATEST / 0.01
    settings: dict = {"x_scale": "jac", "xtol": 1e-5, "ftol": enough, "max_nfev": 40}
    found = scipy.optimize.least_squares(residuals, np.clip(x / unit, low, high), jacobian, (low, high), **settings)
    found.x, found.jac = found.x * unit, found.jac / unit
    return found


def _unit(plant: Plant) -> np.ndarray:
    """Returns the scale of the free parameters: the model's own parameters, 1e-2 rad and 10 ms."""
    return np.concatenate([plant.nominal.vector()[: 4 * plant.n], np.full(plant.n + 1, 0.01)])


def _half_widths(plant: Plant, log: Log, part: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Computes half the widths of the 95% intervals [p]: linear theory, plus the error of the physics step.

    Raises:
        UserError: a parameter has no effect in the log.
    """
    unit, n = _unit(plant), plant.n
    steps = _WIDE * np.diag(np.where(np.arange(len(x)) < 4 * n, x, unit))
    more, less = (_read(plant, log, list(x + sign * steps), part) for sign in (1, -1))
    seen = ((more - less).reshape(len(x), -1) / (2 * _WIDE)).T
    jacobian = np.concatenate([seen, np.eye(len(x))[: 4 * n] * (x / unit)[: 4 * n, None] * _noise(log) / _SURE])
    (path,), (finer,) = _read(plant, log, [x], part), _read(plant.finer(), log, [x], part)
    residuals, shift = path - log.positions[part], 2 * (finer - path).ravel()  # of first order in the step
    scale = np.linalg.norm(jacobian, axis=0)
    try:
        factor = scipy.linalg.cho_factor((jacobian / scale).T @ (jacobian / scale))
    except (np.linalg.LinAlgError, ValueError):
        raise UserError(
            "the log does not determine all parameters: record one in which every joint moves slowly and fast"
        ) from None
    variance = np.diag(scipy.linalg.cho_solve(factor, np.eye(len(scale)))) / scale**2
    moved = scipy.linalg.cho_solve(factor, (seen / scale).T @ shift) / scale
    free = residuals.size - len(x)
    noise = np.sum(residuals**2) / free * _correlation(residuals)
    return (scipy.special.stdtrit(free, _LEVEL) * np.sqrt(noise * variance) + np.abs(moved)) * np.diag(steps) / _WIDE


def _noise(log: Log) -> float:
    """Returns the noise of a reading for the prior [rad or m]: ``_NOISE``, or the rounding to the encoders' counts."""
    return max(_NOISE, _count(log) / np.sqrt(12))


def _count(log: Log) -> float:
    """Returns the size of an encoder's count [rad or m]: the smallest difference of two readings of a joint."""
    steps = [np.diff(np.unique(np.round(column, 6))) for column in log.positions.T]
    return float(np.median([step.min() for step in steps if len(step)] or [0.0]))


def _alike(log: Log, residuals: Float[np.ndarray, "k n"]) -> float:
    """Returns the factor of the intervals' widths: ``_ALIKE`` where rounding to counts is all the noise that the readings have.

    Servos round their targets to the same counts. A joint that follows slowly then reads its target, whatever its drive: the
    rounding follows the motion, and no correlation in time shows that.
    """
    return _ALIKE if np.sqrt(np.mean(residuals**2)) < _count(log) / 2 else 1.0


def _correlation(residuals: Float[np.ndarray, "k n"]) -> float:
    """Computes how many readings equal one independent reading: 1 + 2 sum of the autocorrelation while it is above 0.05."""
    total = np.sum(residuals**2)
    out = 1.0
    for lag in range(1, min(400, len(residuals) // 2)):
        rho = np.sum(residuals[lag:] * residuals[:-lag]) / max(total, 1e-30)
        if rho < 0.05:
            break
        out += 2 * rho
    return float(out)
