"""The model folder of an import, written whole or not at all."""

import contextlib
import dataclasses
import hashlib
import json
import os
import pathlib
import re
import shutil
import uuid
from collections.abc import Iterator, Mapping
from typing import Any

from mjx_nero import files
from mjx_nero.sim import robot_file
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.types import UserError
from mjx_nero.urdf.report import Report

_REPORT = "report.json"
_NAMES = re.compile(r"model\.xml|robot\.yaml|report\.json|meshes/[^/]+\.stl")  # everything that an import writes
_MAX_REPORT = 50_000_000  # bytes
_MAX_FILE = 1_000_000_000  # bytes


def check(out: pathlib.Path, force: bool) -> None:
    """Checks that the folder may be made: it is absent or empty, or, with ``force``, it holds only what an import wrote.

    Raises:
        UserError: it may not; the message names the first file that no import wrote, or that has changed since.
    """
    try:
        if out.is_symlink() or out.exists() and not out.is_dir():
            raise UserError(f"{out} is not a folder: pass another --out")
        found = sorted(_entries(out)) if out.exists() else []
    except (OSError, ValueError) as error:
        if isinstance(error, UserError):
            raise
        raise UserError(f"cannot write {out}: {getattr(error, 'strerror', None) or error}; pass another --out") from None
    if not found:
        return
    written = _written(out)
    if not written:
        raise UserError(f"{out} holds other files: pass another --out")
    if not force:
        raise UserError(f"{out} holds an imported robot: pass --force to replace it, or another --out")
    for name in found:
        if name not in written:
            raise UserError(f"{out / name} was not written by an import: move it out of {out}, or pass another --out")
        if name != _REPORT and _hash(files.read_bytes(out / name, _MAX_FILE)) != written[name]:
            raise UserError(f"{out / name} was changed since it was imported: move it out of {out}, or pass another --out")


def _entries(out: pathlib.Path) -> Iterator[str]:
    """Lists everything in the folder except ``meshes`` itself; links are not followed."""
    for entry in os.scandir(out):
        if entry.name == "meshes" and entry.is_dir(follow_symlinks=False):
            yield from (f"meshes/{inner.name}" for inner in os.scandir(entry.path))
        else:
            yield entry.name


def _written(out: pathlib.Path) -> dict[str, str]:
    """Returns file -> hash from the report of the import that made the folder; empty without such a report."""
    try:
        listed = json.loads(files.read_bytes(out / _REPORT, _MAX_REPORT))["files"]
        return {name: str(value) for name, value in listed.items() if _NAMES.fullmatch(name)} | {_REPORT: ""}
    except (UserError, ValueError, LookupError, TypeError, AttributeError, RecursionError):
        return {}


def _hash(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def write(out: pathlib.Path, text: str, stl: Mapping[str, bytes], robot: RobotCfg, report: Report, force: bool) -> None:
    """Makes the folder of a robot, if MuJoCo accepts the model.

    Raises:
        UserError: the folder cannot be written, or MuJoCo refuses the model.
    """
    with making(out, force) as made:
        write_model(made, text, stl)
        robot_file.write(made, dataclasses.replace(robot, folder=str(made)))
        (made / _REPORT).write_text(report.json(hashes(made)), encoding="utf-8")
        robot_file.read(made)


def write_model(made: pathlib.Path, text: str, stl: Mapping[str, bytes]) -> None:
    """Writes ``model.xml`` and its meshes."""
    (made / "model.xml").write_text(text, encoding="utf-8")
    if stl:
        (made / "meshes").mkdir()
    for name, content in stl.items():
        (made / "meshes" / f"{name}.stl").write_bytes(content)


def hashes(made: pathlib.Path) -> dict[str, str]:
    """Returns file -> hash of all that has been written, for the report."""
    return {name: _hash((made / name).read_bytes()) for name in sorted(_entries(made))}


@contextlib.contextmanager
def making(out: pathlib.Path, force: bool) -> Iterator[pathlib.Path]:
    """Yields a folder with a hidden name beside ``out``. At the end it becomes ``out``; after an error nothing is left.

    Raises:
        UserError: the folder cannot be written.
    """
    made = out.parent / f".{out.name[:200]}.{uuid.uuid4().hex[:8]}"
    absent = [folder for folder in (out.parent, *out.parent.parents) if not os.path.exists(folder)]
    try:
        made.mkdir(parents=True)
        yield made
        _move(made, out, force)
    except (OSError, ValueError) as error:  # ValueError: a name with a NUL
        if isinstance(error, UserError):
            raise
        raise UserError(f"cannot write {out}: {getattr(error, 'strerror', None) or error}; pass another --out") from None
    finally:
        with contextlib.suppress(OSError, ValueError):
            if made.exists():
                shutil.rmtree(made, ignore_errors=True)
            for folder in absent:  # parents made here, innermost first, if they are still empty
                folder.rmdir()


def record(out: pathlib.Path, name: str, content: Any) -> None:
    """Adds or replaces an entry of an import's report.

    Raises:
        UserError: the report is missing or cannot be written.
    """
    held = files.read_json(out / _REPORT, _MAX_REPORT)
    files.write_json(out / _REPORT, {**held, name: content})


def _move(made: pathlib.Path, out: pathlib.Path, force: bool) -> None:
    """Moves ``made`` to ``out``, deleting only an earlier import's files there."""
    check(out, force)
    if not out.exists():
        made.rename(out)
        return
    old = out.parent / f"{made.name}.old"
    out.rename(old)
    try:
        check(old, force)
        made.rename(out)
    except BaseException:
        old.rename(out)
        raise
    for name in _written(old):
        (old / name).unlink(missing_ok=True)
    for folder in (old / "meshes", old):
        with contextlib.suppress(OSError):
            folder.rmdir()
