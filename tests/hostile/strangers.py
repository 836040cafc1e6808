"""Inputs from strangers by the thousand: python tests/hostile/strangers.py --count 1000 [--kind folder] [--seed 7].

Run folders with links, pipes and devices in them, their configs and names, URDFs, requests and messages to the viewer, misuse of
Gymnasium, signals, and numbers in every file. Each input ends in one line or works: no traceback, no effect outside of its
folder, at most 30 s and 2 GB. The same seed makes the same inputs. What got through is counted, and written to --finds.
"""

import argparse
import contextlib
import datetime
import functools
import json
import os
import pathlib
import random
import shutil
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator

HERE = pathlib.Path(__file__).resolve().parent
if __name__ == "__main__":
    os.environ.pop("JAX_COMPILATION_CACHE_DIR", None)  # before JAX reads it: what it would write there is outside of the folders
    sys.path[:0] = [str(HERE.parents[1]), str(HERE), str(HERE.parent), str(HERE.parent / "tools")]

import bad_meshes  # noqa: E402
import folders  # noqa: E402
import fuzz  # noqa: E402
import misuse  # noqa: E402
import server  # noqa: E402
import sweep  # noqa: E402
import worlds  # noqa: E402

LONGEST = 500  # characters of a message
SHARES = {
    "folder": 0.15,
    "config": 0.1,
    "names": 0.05,
    "urdf": 0.1,
    "mesh": 0.1,
    "files": 0.2,
    "http": 0.1,
    "messages": 0.1,
    "gym": 0.1,
}
SIGNALS = 8  # trainings that are ended, whatever the count
# Each input of these is given to a process of its own: (random numbers, folder) -> what it is, and what is done with it.
FORKED: dict[str, Callable[[random.Random, pathlib.Path], tuple[str, Callable[[], None]]]] = {
    "folder": folders.entries,
    "config": folders.config,
    "names": folders.names,
    "urdf": worlds.urdf,
    "mesh": bad_meshes.mesh,
}
# Many inputs of these to one process, as what they are given to takes long to start: (seed, count) -> each, and its fault.
TOGETHER: dict[str, Callable[[int, int], Iterator[tuple[str, str]]]] = {
    "http": misuse.http,
    "messages": misuse.messages,
    "gym": misuse.gym,
    "signals": misuse.signals,
}


def today() -> int:
    """A seed of the day, so that a find can be made again, and another day tries others."""
    return int(datetime.date.today().strftime("%Y%m%d"))


def forked(kind: str, seed: int) -> tuple[str, str]:
    """An input given to a child with limits: what it is, and what is wrong with how it ended; empty if nothing is."""
    folder = pathlib.Path(tempfile.mkdtemp())
    for name in ("work", "home", "mine"):
        (folder / name).mkdir()
    (folder / "mine" / "keys.yaml").write_text("secret_key: 12345\n")
    (folder / "mine" / "000000000512.safetensors").write_text("precious")
    try:
        what, call = FORKED[kind](random.Random(f"{kind} {seed}"), folder)
        before = owned(folder)
        outcome = server.run(call, folder)
        return f"{kind} {seed}: {what}", fault(outcome, folder, before)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def owned(folder: pathlib.Path) -> dict[str, tuple]:
    """What lies beside the folder that is the stranger's."""
    found = {}
    for path in [folder, *folder.glob("mine/**/*"), *folder.glob("work/*")]:
        status = path.lstat()
        found[str(path)] = (status.st_mode, path.read_bytes() if path.is_file() and not path.is_symlink() else b"")
    return found


def fault(outcome: dict, folder: pathlib.Path, before: dict[str, tuple]) -> str:
    """What is wrong with how a child has ended; empty if nothing is."""
    said = {name: (folder / name).read_text(errors="replace") for name in ("stdout", "stderr", "outside")}
    for name in said:
        (folder / name).unlink()
    if outcome["killed"]:
        return f"{outcome['killed']}: {outcome['seconds']:.0f} s, {outcome['memory'] / 1e6:.0f} MB"
    if said["outside"] or owned(folder) != before:
        return f"effect outside: {said['outside']}{sorted(set(map(str, owned(folder).items())) ^ set(map(str, before.items())))}"
    if "secret" in said["stdout"] + said["stderr"]:
        return f"tells of the user's files: {said['stdout']}{said['stderr']}"
    lines = [line for line in said["stderr"].splitlines() if line.startswith("error: ")]
    one = len(lines) == 1 and lines[0].isprintable() and len(lines[0]) <= LONGEST
    if "Traceback" in said["stderr"] or outcome["code"] not in (0, 2) or (outcome["code"] == 2) != one:
        return f"exit {outcome['code']}: {said['stderr'][-3000:]}"
    return ""


def of_files(seed: int, count: int) -> Iterator[tuple[str, str]]:
    """Numbers and words in every file that a reader takes; half of them one number, half of them any change."""
    readers = list(sweep.WORDS)
    each = -(-count // (2 * len(readers)))
    for reader in readers:
        drawn = random.Random(f"{reader} {seed}")
        changed = [(f"{reader}: changed", worlds.changed(drawn, fuzz.corpus(reader)[-1])) for _ in range(each)]
        for name, content in [*sweep.files(reader, each, seed), *changed]:
            try:
                fuzz.judge(reader, content)
                yield name, ""
            except Exception as error:
                yield f"{name}\n{content[:300]!r}", "".join(traceback.format_exception(error))[-3000:]


def limited(kind: str, seed: int, count: int) -> Iterator[tuple[str, str]]:
    """Inputs that are given to one process, which has limits of memory."""
    folder = pathlib.Path(tempfile.mkdtemp())
    for name in ("work", "home"):
        (folder / name).mkdir()

    def call() -> None:
        with open(folder / "results", "w", buffering=1) as file:
            for what, why in {**TOGETHER, "files": of_files}[kind](seed, count):
                file.write(json.dumps([what, why]) + "\n")

    outcome = server.run(call, folder, seconds=36_000.0)
    (folder / "results").touch()
    results = [json.loads(line) for line in (folder / "results").read_text().splitlines()]
    said = (folder / "stderr").read_text(errors="replace")
    yield from results
    if outcome["code"] or outcome["killed"] or "Traceback" in said:
        yield f"{kind} {seed}", f"after {len(results)} inputs: {outcome} {said[-3000:]}"
    shutil.rmtree(folder, ignore_errors=True)


def tried(kind: str, seed: int, count: int) -> Iterator[tuple[str, str]]:
    """What each input of a kind is, and what is wrong with how it ended."""
    if kind in FORKED:
        return (forked(kind, seed * 1_000_000 + i) for i in range(count))
    return limited(kind, seed, count)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=1000, help="inputs in all (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--kind", choices=(*SHARES, "signals"), action="append", help="again for more (default: all)")
    parser.add_argument("--finds", type=pathlib.Path, default=pathlib.Path("finds.txt"), help="where finds are written")
    args = parser.parse_args()
    server.preload()
    kinds = args.kind or [*SHARES, "signals"]
    total, found, file = 0, 0, args.finds.resolve().open("a")
    for kind in kinds:
        began, counts = time.monotonic(), [0, 0]
        count = SIGNALS if kind == "signals" else round(args.count * SHARES[kind] / sum(SHARES.get(k, 0) for k in kinds))
        for what, why in tried(kind, args.seed, count):
            counts[0] += 1
            if why:
                counts[1] += 1
                print(f"{what}\n{why}\n", file=file, flush=True)
        total, found = total + counts[0], found + counts[1]
        print(f"{kind:<10} {counts[0]:>6,} inputs, {counts[1]} got through, {time.monotonic() - began:.0f} s", flush=True)
    print(f"{total:,} inputs of seed {args.seed}; {found} got through")
    return 1 if found else 0


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt):
        os.environ["JAX_PLATFORMS"] = "cpu"
        functools.partial(sys.exit, main())()
