"""Kills one run again and again, at random moments, and lets the same command go on: python tests/faults/kill_many.py --kills 200

Three ways to die: SIGKILL; SIGTERM, after which nothing may be lost; and a power cut, which is SIGKILL and then, of every file
that was not synchronised to the disk, the end cut off (files that are appended to, and parts of files not yet whole).
When all kills are done, the last run goes on to its end; what it came to must be what a run comes to that nothing disturbed.
"""

import argparse
import json
import os
import pathlib
import random
import signal
import subprocess
import sys
import tempfile
import time

import numpy as np
from safetensors import safe_open

ROOT = pathlib.Path(__file__).resolve().parents[2]
SIZES = ["--num-envs", "8", "--ppo.unroll_length", "4", "--ppo.num_minibatches", "2", "--ppo.num_epochs", "1", "--no-video"]
SIZES += ["--ppo.network.actor", "(8,)", "--ppo.network.critic", "(8,)", "--env.episode_length_s", "0.2"]
PER, PER_GPU = 64, 640  # env steps of a chunk: two iterations on a CPU, twenty on a GPU


# Physics that compiles at once, and whose programs JAX keeps: a start takes seconds, which leaves time for many kills.
KINEMATIC = "import mjx_nero; from kinematic import Kinematic; mjx_nero.ManipulationEnv.physics = Kinematic(); "
MAIN = "from mjx_nero.tools import cli; from mjx_nero.tools.train import main; cli.run(main)"


def flags(says: str | None) -> argparse.ArgumentParser:
    """What every run that is spoilt can be told."""
    parser = argparse.ArgumentParser(description=says, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="nero_reach")
    parser.add_argument("--impl", default="native")
    parser.add_argument("--kinematic", action="store_true", help="physics without MuJoCo, which starts in seconds")
    parser.add_argument("--every", type=int, default=4 * PER, help="env steps between checkpoints; on a GPU a chunk is 640")
    parser.add_argument("--seed", type=int, default=0)
    return parser


def chunk(args: argparse.Namespace) -> int:
    """Env steps of a chunk: the least between two checkpoints."""
    return PER_GPU if args.impl == "warp" else PER


def surroundings() -> dict[str, str]:
    """Environment variables of a run that finds this package and the tests' modules, and whatever this process finds."""
    path = [str(ROOT), str(ROOT / "tests"), os.environ.get("PYTHONPATH", "")]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, path))}


def command(args: argparse.Namespace, out: pathlib.Path, steps: int) -> list[str]:
    """The one command of a run."""
    size = ["--num-timesteps", str(steps), "--checkpoint-every", str(args.every), "--eval-every", str(20 * args.every)]
    where = ["--env", "nero_lift" if args.kinematic else args.env, "--impl", args.impl, "--out", str(out), "--resume", "auto"]
    return [sys.executable, "-c", (KINEMATIC if args.kinematic else "") + MAIN, *where, *size, *SIZES]


def newest(run: pathlib.Path) -> int:
    """Env steps of the newest whole checkpoint; -1: there is none."""
    for path in sorted((run / "checkpoints").glob("[0-9]*.safetensors"), reverse=True):
        try:
            with safe_open(path, framework="numpy") as file:
                file.keys()
            return int(path.stem)
        except Exception as error:
            print(f"damaged: {path.name}: {error}")
    return -1


def noted(run: pathlib.Path) -> int:
    """Env steps of the last whole row of metrics: how far the run is known to have come."""
    path = run / "metrics.jsonl"
    lines = path.read_text(errors="replace").splitlines() if path.exists() else []
    return max((json.loads(line)["steps"] for line in lines if line.startswith("{") and line.endswith("}")), default=0)


def arrays(path: pathlib.Path) -> dict[str, bytes]:
    """The arrays of a checkpoint."""
    with safe_open(path, framework="numpy") as file:
        return {name: np.asarray(file.get_tensor(name)).tobytes() for name in file.keys()}


def cut(run: pathlib.Path, chance: random.Random) -> None:
    """What a power cut does to files that nobody synchronised."""
    for path in [*run.glob("metrics.jsonl"), *run.glob("tensorboard/*"), *run.rglob(".*.part*")]:
        size = path.stat().st_size
        os.truncate(path, chance.randrange(size + 1) if chance.random() < 0.5 else size)


def main() -> None:
    """Kills, and counts what was lost."""
    parser = flags(__doc__)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--longest", type=float, default=8.0, help="seconds of training before a kill, at most")
    args = parser.parse_args()
    per = chunk(args)
    chance, folder = random.Random(args.seed), pathlib.Path(tempfile.mkdtemp())
    run, good, lost_most = folder / "run", 0, 0
    argv, env = command(args, run, 4_000_000), surroundings()
    for i in range(args.kills):
        before, how = newest(run), chance.choice(["SIGKILL", "SIGTERM", "power cut"])
        process = subprocess.Popen(argv, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=env)
        assert process.stdout is not None
        compiling = chance.random() < 0.1
        said = []
        while not compiling:
            said.append(process.stdout.readline())
            if not said[-1] or "compiled in" in said[-1]:
                break
        time.sleep(chance.uniform(0, args.longest))
        process.send_signal(signal.SIGTERM if how == "SIGTERM" else signal.SIGKILL)
        rest, _ = process.communicate()
        text = "".join(said) + rest
        if how == "power cut":
            cut(run, chance)
        after, reached = newest(run), noted(run)
        lost = max(0, reached - max(after, 0))
        fine = after >= before and "Traceback" not in text and lost <= max(args.every, per) + per
        if how == "SIGTERM" and not compiling:
            fine = fine and process.returncode == 143 and lost == 0
        good, lost_most = good + fine, max(lost_most, lost)
        said_of_it = f"{i + 1:4} {how:9} exit {process.returncode:4} steps {before} to {after}, lost {lost}"
        print(f"{said_of_it}{'' if fine else '  WRONG'}", flush=True)
        if not fine:
            print(text)
    steps = (newest(run) // per + 2) * per
    for path in (run, folder / "undisturbed"):
        subprocess.run(command(args, path, steps), check=True, capture_output=True, env=env)
    name = f"checkpoints/{steps:012d}.safetensors"
    same = arrays(run / name) == arrays(folder / "undisturbed" / name)
    print(f"{good} of {args.kills} went on, at most {lost_most} env steps lost; after {steps} steps as if undisturbed: {same}")
    sys.exit(0 if good == args.kills and same else 1)


if __name__ == "__main__":
    main()
