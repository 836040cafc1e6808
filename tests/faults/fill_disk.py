"""Fills a run's disk at random moments, makes room, and goes on: python tests/faults/fill_disk.py --folder DISK

DISK is an empty file system of its own of a few megabytes: ``mkdir disk && mount -t tmpfs -o size=8m none disk``. Each time
the run has to end by itself, within a minute, in one line without a traceback, and all checkpoints that it kept have to be whole.
At the end it must have come to what a run comes to that nothing disturbs.
"""

import pathlib
import random
import subprocess
import sys
import tempfile
import time

from kill_many import arrays, chunk, command, flags, newest, surroundings

from mjx_nero.learn import checkpoint
from mjx_nero.runs import checkpoints

LONGEST = 60.0  # seconds from the full disk to the end of the run


def fill(folder: pathlib.Path, left: int) -> pathlib.Path:
    """Takes all room but ``left`` bytes."""
    path = folder / "filler"
    with path.open("wb", buffering=0) as file:
        try:
            while True:
                file.write(bytes(1 << 16))
        except OSError:
            pass
    with path.open("r+b") as file:
        file.truncate(max(0, path.stat().st_size - left))
    return path


def main() -> None:
    """Fills, and says what came of it."""
    parser = flags(__doc__)
    parser.add_argument("--folder", type=pathlib.Path, required=True, help="a small file system")
    parser.add_argument("--moments", type=int, default=20)
    parser.add_argument("--longest", type=float, default=6.0, help="seconds of training before the disk is full, at most")
    args = parser.parse_args()
    chance, run, good = random.Random(args.seed), args.folder / "run", 0
    argv, env = command(args, run, 40_000_000), surroundings()
    for i in range(args.moments):
        before, left = newest(run), chance.choice([0, 100, 3_000, 10_000, 30_000])
        process = subprocess.Popen(argv, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=env)
        assert process.stdout is not None
        said = [""]
        while "compiled in" not in said[-1]:
            said.append(process.stdout.readline())
            if not said[-1]:
                break
        time.sleep(chance.uniform(0, args.longest))
        filler = fill(args.folder, left)
        began = time.monotonic()
        try:
            rest, _ = process.communicate(timeout=LONGEST)
        except subprocess.TimeoutExpired:
            process.kill()
            rest = "it did not end\n"
        took, text = time.monotonic() - began, "".join(said) + rest
        filler.unlink()
        for path in checkpoints.saved(run):
            checkpoint.verify(path)
        after = newest(run)
        fine = process.returncode == 2 and "Traceback" not in text and after >= before and "resume with" in text
        good += fine
        told = f"{i + 1:4} {left:6} bytes left, exit {process.returncode:3} after {took:4.1f} s, steps {before} to {after}"
        print(f"{told}{'' if fine else '  WRONG'}", flush=True)
        if not fine:
            print(text)
    per = chunk(args)
    steps = (newest(run) // per + 2) * per
    undisturbed = pathlib.Path(tempfile.mkdtemp()) / "run"
    for path in (run, undisturbed):
        subprocess.run(command(args, path, steps), check=True, capture_output=True, env=env)
    name = f"checkpoints/{steps:012d}.safetensors"
    same = arrays(run / name) == arrays(undisturbed / name)
    print(f"{good} of {args.moments} ended and went on; after {steps} steps as if undisturbed: {same}")
    sys.exit(0 if good == args.moments and same else 1)


if __name__ == "__main__":
    main()
