"""Runs commands on hostile files, each in a forked child with limits: python server.py, a JSON line a command on stdin.

The package is imported once; JAX starts no threads before a child needs it, so that forking is safe.
"""

import contextlib
import functools
import json
import os
import pathlib
import resource
import signal
import sys
import time
from collections.abc import Callable, Sequence

SECONDS, MEMORY = 30, 2e9  # of processor time and of the clock, of bytes that are really there
_BACKSTOP = 16 << 30  # bytes of addresses: JAX asks for many that it never uses
_WRITES = {"os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.symlink", "os.link", "os.truncate", "os.chmod"}
_ELSEWHERE = ("/dev/", "/proc/self/")


def child(call: Callable[[], None], folder: pathlib.Path, seconds: float) -> None:
    """Does the call in ``folder/work``.

    What Python writes outside of ``folder`` is noted in ``folder/outside``, and so is what it opens of ``folder/mine``.
    """
    os.setsid()
    sys.dont_write_bytecode = True  # what Python compiles of its own modules is no effect of a command
    resource.setrlimit(resource.RLIMIT_AS, (_BACKSTOP, _BACKSTOP))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_CPU, (int(seconds), int(seconds) + 1))
    home = {"HOME": "home", "TMPDIR": "home", "XDG_CACHE_HOME": "home/cache"}
    os.environ.update({name: str(folder / value) for name, value in home.items()})
    os.chdir(folder / "work")
    for stream, name in ((1, "stdout"), (2, "stderr")):
        os.dup2(os.open(folder / name, os.O_WRONLY | os.O_CREAT, 0o600), stream)
    outside = os.open(folder / "outside", os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)

    def watch(event: str, args: tuple) -> None:
        writes = event in _WRITES or event == "open" and isinstance(args[2], int) and args[2] & (os.O_WRONLY | os.O_RDWR)
        if writes and isinstance(args[0], str | bytes | os.PathLike):
            path = os.path.abspath(os.fsdecode(args[0]))
            if not path.startswith((f"{folder}/", *_ELSEWHERE)):
                os.write(outside, f"{event} {path}\n".encode())
        elif event == "open" and isinstance(args[0], str | bytes | os.PathLike):
            if os.path.realpath(os.fsdecode(args[0])).startswith(mine):
                os.write(outside, f"{event} {os.fsdecode(args[0])}\n".encode())

    mine = os.path.realpath(folder / "mine") + "/"
    sys.addaudithook(watch)
    call()


def program(call: Callable[[], None]) -> None:
    """A call as the console script does it: a user's mistake is one line and exit status 2."""
    from mjx_nero.tools import cli

    cli.run(lambda _: call())


def command(argv: Sequence[object]) -> None:
    """The console script."""
    from mjx_nero import __main__
    from mjx_nero.tools import cli

    sys.argv = ["mjx-nero", *map(str, argv)]
    cli.run(__main__.main)


def run(call: Callable[[], None], folder: pathlib.Path, seconds: float = SECONDS) -> dict[str, object]:
    """Forks, waits, and says how it ended.

    The time in which a busy machine gives the child no core is none of the child's, so it is taken off the clock's.
    """
    started, memory, why = time.monotonic(), 0.0, ""
    queued: dict[int, float] = {}  # by process: the child, and those that it starts and waits for
    pid = os.fork()
    if not pid:
        code = 70
        try:
            child(call, folder, seconds)
            code = 0
        except SystemExit as stop:
            code = stop.code if isinstance(stop.code, int) else 70
        except BaseException:
            sys.excepthook(*sys.exc_info())
        finally:
            with contextlib.suppress(Exception):
                sys.stdout.flush()
                sys.stderr.flush()
            os._exit(code)
    while True:
        done, status, used = os.wait4(pid, os.WNOHANG)
        if done:
            break
        memory = max(memory, sum(map(_resident, _family(pid))))
        queued |= {each: max(queued.get(each, 0.0), _queued(each)) for each in _family(pid)}
        waited = sum(queued.values())
        if time.monotonic() - started - waited > seconds or memory > MEMORY:
            why = "time" if memory <= MEMORY else "memory"
            os.killpg(pid, signal.SIGKILL) if os.getpgid(pid) == pid else os.kill(pid, signal.SIGKILL)
            _, status, used = os.wait4(pid, 0)
            break
        time.sleep(0.02)
    memory, waited = max(memory, 1024.0 * used.ru_maxrss), sum(queued.values())
    code, took = os.waitstatus_to_exitcode(status), max(used.ru_utime + used.ru_stime, time.monotonic() - started - waited)
    why = "time" if code in (-signal.SIGXCPU, -signal.SIGKILL) and not why else why
    return {"code": code, "killed": why, "seconds": took, "memory": memory}


def _family(pid: int) -> list[int]:
    """A process and those that it has started."""
    with contextlib.suppress(OSError, ValueError):
        return [pid, *map(int, pathlib.Path(f"/proc/{pid}/task/{pid}/children").read_text().split())]
    return [pid]


def _resident(pid: int) -> float:
    """Bytes of memory."""
    try:
        return 4096.0 * int(pathlib.Path(f"/proc/{pid}/statm").read_text().split()[1])
    except (OSError, IndexError):
        return 0.0


def _queued(pid: int) -> float:
    """Time that its main thread was ready to run and had no core [s]."""
    try:
        return 1e-9 * int(pathlib.Path(f"/proc/{pid}/schedstat").read_text().split()[1])
    except (OSError, IndexError):
        return 0.0


def preload() -> None:
    """Imports what commands import, so that no child has to."""
    import mjx_nero.control.rmpflow
    import mjx_nero.learn.ppo.learner
    import mjx_nero.runs.evaluation
    import mjx_nero.runs.training
    import mjx_nero.tools.eval
    import mjx_nero.tools.import_urdf
    import mjx_nero.tools.inspect
    import mjx_nero.tools.inspection
    import mjx_nero.tools.self_test
    import mjx_nero.tools.train
    import mjx_nero.tools.train_run  # noqa: F401


def main() -> None:
    """Serves until stdin ends."""
    preload()
    print("ready", flush=True)
    for line in sys.stdin:
        order = json.loads(line)
        print(json.dumps(run(functools.partial(command, order["argv"]), pathlib.Path(order["folder"]))), flush=True)


if __name__ == "__main__":
    main()
