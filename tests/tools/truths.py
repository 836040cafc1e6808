"""How well identification finds what it should: python tests/tools/truths.py --robot nero --truths 20 --json truths.json

Draws arms at random, records each with noise, encoder counts, offsets and a delay, and identifies it again. With
--emulate so101 the arm is an emulated one: driver, safety layer and the servos' counts stand between targets and drives."""

import argparse
import json
import pathlib
import tempfile
import time

import numpy as np

from mjx_nero.deploy.emulators import timeless
from mjx_nero.deploy.emulators.plant import Faults
from mjx_nero.identify import log as logs
from mjx_nero.identify.fit import identify
from mjx_nero.identify.plant import POSITIVE, Drives, Plant, usual_step
from mjx_nero.identify.simulate import RecordCfg, draw, record
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.tasks import registry
from mjx_nero.tools.deploy import trial


def emulated(robot: RobotCfg, kind: str, cfg: RecordCfg) -> tuple[logs.Log, Drives]:
    """The log of an emulated arm, and its drives; its encoders have no offsets."""
    truth = draw(Plant(robot, usual_step(robot)).nominal, cfg, np.random.default_rng(cfg.seed))
    with tempfile.TemporaryDirectory() as folder:
        path = pathlib.Path(folder) / "log.csv"
        trial.recorded(path, robot, kind, Faults(late=truth.delay), cfg.seconds, truth)
        return logs.read(path, robot.arm.joints), truth


def compare(robot: str, seed: int, cfg: RecordCfg, finer: int = 1, emulate: str = "") -> dict:
    """Errors (relative; offsets in rad, delay in s) and whether the intervals hold the truth, for one arm.

    Args:
        finer: by how much the true arm's physics step is shorter than the model's.
        emulate: kind of the emulated arm; empty: it is simulated.
    """
    own = registry.robot(robot)
    plant = Plant(own, usual_step(own))
    log, truth = emulated(own, emulate, cfg) if emulate else record(Plant(own, plant.dt / finer), cfg)
    begun, cpu = time.perf_counter(), time.process_time()
    fit = identify(plant, log)
    out = {
        "seed": seed,
        "seconds": time.perf_counter() - begun,
        "cpu_seconds": time.process_time() - cpu,
        "errors": {},
        "inside": {},
        "widths": {},
    }
    for name in (*POSITIVE, "offset", "delay"):
        found, true, low, high = (np.atleast_1d(getattr(x, name)) for x in (fit.drives, truth, fit.low, fit.high))
        out["errors"][name] = ((found - true) / (true if name in POSITIVE else 1.0)).tolist()
        out["inside"][name] = ((low <= true) & (true <= high)).tolist()
        out["widths"][name] = ((high - low) / 2 / (true if name in POSITIVE else 1.0)).tolist()
    out["rms"] = fit.rms.tolist()
    return out


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robot", default="nero")
    parser.add_argument("--truths", type=int, default=20)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--noise", type=float, default=1e-4)
    parser.add_argument("--resolution", type=float, default=1e-4)
    parser.add_argument("--finer", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--emulate", choices=timeless.LINES, default="", help="the arm is an emulated one of this kind")
    parser.add_argument("--json", type=pathlib.Path)
    args = parser.parse_args()
    results = []
    for seed in range(args.first, args.first + args.truths):
        drawn = {"scatter": 1.3, "delay": 0.03} if args.emulate else {"scatter": 1.5, "offset": 0.02, "delay": 0.06}
        cfg = RecordCfg(noise=args.noise, resolution=args.resolution, seed=seed, seconds=args.seconds, **drawn)
        results.append(compare(args.robot, seed, cfg, args.finer, args.emulate))
        errors = results[-1]["errors"]
        worst = {name: f"{np.abs(value).max():.2%}" for name, value in errors.items() if name in POSITIVE}
        print(
            seed, worst, f"offset {np.abs(errors['offset']).max():.1e} rad", f"delay {1e3 * errors['delay'][0]:+.3f} ms", end=" "
        )
        print(f"{results[-1]['seconds']:.0f} s, {results[-1]['cpu_seconds']:.0f} s of CPU", flush=True)
        if args.json:
            args.json.write_text(json.dumps(results))
    print("worst of all, share within 5%, share of intervals that hold the truth:")
    for name in (*POSITIVE, "offset", "delay"):
        errors = np.abs([r["errors"][name] for r in results])
        inside = np.mean([r["inside"][name] for r in results])
        within = np.mean(errors < (0.05 if name in POSITIVE else 2e-3))
        print(f"{name:10s} {errors.max():.5f} {within:.1%} {inside:.1%}")


if __name__ == "__main__":
    main()
