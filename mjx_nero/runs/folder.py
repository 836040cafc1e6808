"""The folder of a run, which one process owns at a time."""

import contextlib
import itertools
import os
import pathlib
import re
import shutil
import time
from collections.abc import Iterator
from typing import Any

from mjx_nero import files
from mjx_nero.errors import UserError
from mjx_nero.learn import machines
from mjx_nero.runs.logs import METRICS

CONFIG, SUMMARY = "config.json", "summary.json"
_LOCK = ".lock"
_WRITTEN = (METRICS, "seeds.json", "policy.safetensors", "best.safetensors", "curve.png", "video.mp4")
_FOLDERS = ("checkpoints", "tensorboard", "wandb")
_RELINKED = re.compile(r"wandb/(latest-run|debug[\w-]*\.log)")  # links that wandb itself renews at every start
_RUNS = pathlib.Path("runs")


@contextlib.contextmanager
def claim(path: pathlib.Path | None, name: str, goes_on: bool) -> Iterator[pathlib.Path]:
    """Claims the folder of a run for this process until the context ends.

    A folder made here is removed if it is still empty then. Processes other than the first claim nothing, and get the same path.

    Args:
        path: the folder; None: a new one, ``runs/<name>_<time>``.
        goes_on: the folder may hold a run already.

    Raises:
        UserError: the folder holds a run, belongs to a running process, or cannot be written.
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
        lock = files.lock(path / _LOCK)
    except OSError as error:
        raise UserError(f"cannot write to {path or 'runs'}: {error.strerror or error}; pass another --out") from None
    try:
        if (path / CONFIG).exists() and not goes_on:
            raise UserError(f"{path} already holds a run: pass another --out, or --restore {path} to resume it")
        _tidy(path)
        files.own(path / METRICS)
        yield path
    finally:
        with contextlib.suppress(OSError):
            (path / _LOCK).unlink()
        os.close(lock)
        if made and not (path / CONFIG).exists():
            with contextlib.suppress(OSError):  # the folder is not empty
                path.rmdir()
                if path.parent == _RUNS:
                    path.parent.rmdir()


def check(folder: pathlib.Path) -> None:
    """Checks that nothing a run reads or writes leads out of its folder, which is not trusted.

    Raises:
        UserError: one of the run's files or folders is a link, a pipe or a device.
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
    """Writes the run's resolved config.

    Raises:
        UserError: the file cannot be written.
    """
    files.write_json(path / CONFIG, {**run, "versions": machines.versions()})


def _new(name: str) -> pathlib.Path:
    """Makes a new folder, even if many processes look for one at the same moment."""
    stamp = time.strftime("%Y%m%d_%H%M%S")
    _RUNS.mkdir(exist_ok=True)
    for i in itertools.count(1):
        path = pathlib.Path(_RUNS, f"{name}_{stamp}" + (f"_{i}" if i > 1 else ""))
        with contextlib.suppress(FileExistsError):
            path.mkdir()
            return path
    raise AssertionError


def _tidy(folder: pathlib.Path) -> None:
    """Removes half-written files of a killed run."""
    for part in [*folder.glob(f".*{files.PART}*"), *folder.glob(f"checkpoints/.*{files.PART}*")]:
        with contextlib.suppress(OSError):
            shutil.rmtree(part) if part.is_dir() else part.unlink()
