"""The judge of hostile files: how a command has to end that was given one."""

import datetime
import json
import os
import pathlib
import subprocess
import sys

import pytest

HERE = pathlib.Path(__file__).resolve().parent
LONGEST = 500  # characters of a message
SECONDS, MEMORY = 30.0, 2e9


def _without_cache() -> dict[str, str]:
    """The environment without JAX's cache of programs: a judge of what is written would see it written to."""
    return {name: value for name, value in os.environ.items() if name != "JAX_COMPILATION_CACHE_DIR"}


@pytest.fixture(scope="session")
def server():
    """The process that forks a child for every command (``server.py``)."""
    env = {
        **_without_cache(),
        "PYTHONPATH": os.pathsep.join([str(HERE.parents[1]), *filter(None, [os.environ.get("PYTHONPATH")])]),
    }
    env |= {"OPENBLAS_NUM_THREADS": "1", "COLUMNS": "160", "JAX_PLATFORMS": "cpu"}
    server = subprocess.Popen(
        [sys.executable, HERE / "server.py"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=env
    )
    while server.stdout.readline() not in ("ready\n", ""):
        pass
    yield server
    server.stdin.close()
    server.wait(60)


@pytest.fixture
def play(server, tmp_path):
    """``play(make) -> outcome``: writes files by ``make(folder)``, runs the command that it returns, judges what is left.

    The command starts in an empty folder. Nothing may lie anywhere afterwards that was not there before, but ``allowed``.
    """
    (tmp_path / "work").mkdir()
    (tmp_path / "home").mkdir()

    def play(make, allowed=()):
        argv = [str(word) for word in make(tmp_path)]
        before = _listing(tmp_path)
        server.stdin.write(json.dumps({"argv": argv, "folder": str(tmp_path)}) + "\n")
        server.stdin.flush()
        outcome = json.loads(server.stdout.readline())
        for name in ("stdout", "stderr", "outside"):
            path = tmp_path / name
            outcome[name] = path.read_text(errors="replace") if path.exists() else ""
            path.unlink(missing_ok=True)
        print(argv, outcome)
        assert not outcome["killed"], f"{outcome['killed']}: {outcome['seconds']:.0f} s, {outcome['memory'] / 1e6:.0f} MB"
        assert outcome["seconds"] < SECONDS and outcome["memory"] < MEMORY
        assert not outcome["outside"], outcome["outside"]
        left = {name for name, state in _listing(tmp_path).items() if before.get(name) != state}
        left = {name for name in left if not name.startswith(("home/cache", *allowed))} | (set(before) - set(_listing(tmp_path)))
        assert not left, left
        return outcome

    return play


@pytest.fixture
def refuse(play):
    """``refuse(make)``: one line on stderr, exit status 2, nothing left; returns the line."""

    def refuse(make):
        outcome = play(make)
        assert outcome["code"] == 2, outcome
        line = outcome["stderr"].removesuffix("\n")
        assert line.startswith("error: ") and line.isprintable() and len(line) <= LONGEST, line
        return line

    return refuse


@pytest.fixture
def campaign(tmp_path):
    """``campaign(readers)``: half of ``MJX_NERO_FUZZ_MINUTES`` (10) of the fuzzer, in a process with a limit of memory.

    The seed is the day's, so that a failure, which names it, can be repeated, and another day tries other files.
    """

    def campaign(readers):
        minutes = float(os.environ.get("MJX_NERO_FUZZ_MINUTES", "10")) / 2
        seed = datetime.date.today().strftime("%Y%m%d000")
        command = [sys.executable, HERE / "fuzz.py", f"--minutes={minutes}", f"--seed={seed}", "--finds=finds.txt"]
        command += [f"--reader={name}" for name in readers]
        done = subprocess.run(command, cwd=tmp_path, text=True, capture_output=True, env=_without_cache())
        print(done.stdout, done.stderr)
        finds = tmp_path / "finds.txt"
        assert done.returncode == 0, finds.read_text() if finds.exists() else done.stderr

    return campaign


def _listing(folder: pathlib.Path) -> dict[str, tuple]:
    """What lies in the folder: name -> kind, size and time of the last change; a folder's time says nothing of use."""
    found = {}
    for path in sorted(folder.rglob("*")):
        status = path.lstat()
        found[str(path.relative_to(folder))] = (status.st_mode, *((status.st_size, status.st_mtime_ns) if path.is_file() else ()))
    return found
