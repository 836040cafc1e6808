"""Where a run writes: a folder of its own, with one owner."""

import contextlib
import fcntl
import importlib.metadata as metadata
import itertools
import os
import pathlib
import re
import shutil
import sys
import time
from collections.abc import Iterator
from typing import Any

import jax

from mjx_nero import files
from mjx_nero.errors import UserError
from mjx_nero.learn import machines
from mjx_nero.learn.runs.logs import METRICS

CONFIG, SUMMARY = "config.json", "summary.json"
_LOCK = ".lock"
_WRITTEN = (METRICS, "seeds.json", "policy.safetensors", "best.safetensors", "curve.png", "video.mp4")
_FOLDERS = ("checkpoints", "tensorboard", "wandb")
_RELINKED = re.compile(r"wandb/(latest-run|debug[\w-]*\.log)")  # links that wandb itself makes anew at every start
_RUNS = pathlib.Path("runs")


@contextlib.contextmanager
def claim(path: pathlib.Path | None, name: str, goes_on: bool) -> Iterator[pathlib.Path]:
    """The folder of a run, this process's alone until the end.

    If nothing has been written there by then, a folder made here goes again.

    Args:
        path: None makes a new one: ``runs/<name>_<time>``.
        goes_on: it may hold a run.

    A process that is not the first of several owns nothing, and gets the same path.

    Raises:
        UserError: the folder holds a run, belongs to a process that runs, or cannot be written.
    """
    if not machines.first():
        yield path or _RUNS / name
        return
    made = path is None or not path.exists()
    if not made:
        check(pathlib.Path(path or ""))
    try:
        path = path or _new(name)
        path.mkdir(parents=True, exist_ok=True)
        lock = _lock(path)
    except OSError as error:
        raise UserError(f"cannot write to {path or 'runs'}: {error.strerror or error}; pass another --out") from None
    try:
        if (path / CONFIG).exists() and not goes_on:
            raise UserError(f"{path} already holds a run: pass another --out, or --restore {path} to go on with it")
        _tidy(path)
        files.own(path / METRICS)
        yield path
    finally:
        with contextlib.suppress(OSError):
            (path / _LOCK).unlink()
        os.close(lock)
        if made and not (path / CONFIG).exists():
            with contextlib.suppress(OSError):  # it holds something
                path.rmdir()
                if path.parent == _RUNS:
                    path.parent.rmdir()


def check(folder: pathlib.Path) -> None:
    """Nothing that a run reads or writes in its folder leads out of it: a stranger may have made the folder.

    Raises:
        UserError: a link, a pipe or a device stands in place of one of a run's files or folders.
    """
    for name in (_LOCK, CONFIG, SUMMARY, *_WRITTEN):
        files.inside(folder, name)
    for name in _FOLDERS:
        path = files.inside(folder, name)
        for entry in os.scandir(path) if path.is_dir() else ():
            if not _RELINKED.fullmatch(f"{name}/{entry.name}"):
                files.inside(folder, name, entry.name)
    for part in folder.glob(f".*{files.PART}*"):
        files.inside(folder, part.name)


def begin(path: pathlib.Path, run: dict[str, Any]) -> None:
    """Writes the resolved config.

    Raises:
        UserError: it cannot be written.
    """
    files.write_json(path / CONFIG, {**run, "versions": versions()})


def versions() -> dict[str, str]:
    """Versions of what decides a result, and the device."""
    names = ("mjx-nero", "mujoco", "mujoco-mjx", "jax", "brax", "flax", "optax", "warp-lang")
    found = {}
    for name in names:
        with contextlib.suppress(metadata.PackageNotFoundError):
            found[name] = metadata.version(name)
    return {**found, "python": sys.version.split()[0], "device": jax.devices()[0].device_kind}


def _new(name: str) -> pathlib.Path:
    """A folder that was not there, however many processes look for one at the same moment."""
    stamp = time.strftime("%Y%m%d_%H%M%S")
    _RUNS.mkdir(exist_ok=True)
    for i in itertools.count(1):
        path = pathlib.Path(_RUNS, f"{name}_{stamp}" + (f"_{i}" if i > 1 else ""))
        with contextlib.suppress(FileExistsError):
            path.mkdir()
            return path
    raise AssertionError


def _lock(folder: pathlib.Path) -> int:
    """A file that the system keeps locked for as long as this process lives."""
    path = folder / _LOCK
    while True:
        handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK, 0o644)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            owner = os.read(handle, 100).decode(errors="replace").strip()
            os.close(handle)
            raise UserError(
                f"{folder} is in use by {owner or 'another process'}: wait for its end, or pass another --out"
            ) from None
        except OSError:
            return handle  # a file system without locks
        with contextlib.suppress(FileNotFoundError):
            if os.fstat(handle).st_nlink > 1:  # somebody's file that has this name, too
                path.unlink()
            elif os.stat(path).st_ino == os.fstat(handle).st_ino:  # else its owner took it away just before we had it
                os.truncate(handle, 0)
                os.write(handle, f"process {os.getpid()} on {os.uname().nodename}\n".encode())
                return handle
        os.close(handle)


def _tidy(folder: pathlib.Path) -> None:
    """Removes what a killed run had not finished writing."""
    for part in [*folder.glob(f".*{files.PART}*"), *folder.glob(f"checkpoints/.*{files.PART}*")]:
        with contextlib.suppress(OSError):
            shutil.rmtree(part) if part.is_dir() else part.unlink()
