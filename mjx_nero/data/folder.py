"""The folder of a data set: one process owns it, one command makes it, and its pieces appear whole or not at all.

All files of a piece are first written to ``.part``. They are then moved to their places one right after another. The index, which
says how many pieces there are, moves last: a process that dies before then has written nothing, and the next one cleans up.
"""

import contextlib
import os
import pathlib
import shutil
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from mjx_nero import files
from mjx_nero.config.values import short
from mjx_nero.data.episode import Schema, from_json
from mjx_nero.errors import UserError

PART = ".part"
ABOUT = "meta/mjx_nero.json"  # the schema, and how the data set is made
_LOCK = ".lock"

Write = Callable[[pathlib.Path], Any]  # writes the file at that path


@contextlib.contextmanager
def claim(path: pathlib.Path, schema: Schema) -> Iterator[pathlib.Path]:
    """Claims the folder of a data set for this process until the context ends.

    It is made if it does not exist. If it holds no episode at the end, what was made here is removed.

    Raises:
        UserError: the folder holds something else or another schema, belongs to a running process, or cannot be written.
    """
    check(path, schema)
    made = not path.exists()
    try:
        path.mkdir(parents=True, exist_ok=True)
        lock = files.lock(path / _LOCK)
    except OSError as error:
        raise UserError(f"cannot write to {path}: {error.strerror or error}; pass another folder") from None
    try:
        with contextlib.suppress(FileNotFoundError):
            shutil.rmtree(path / PART)
        if _bare(path):  # new, or left without an episode by an agent of another kind
            files.write_json(path / ABOUT, schema.to_json())
        yield path
    finally:
        shutil.rmtree(path / PART, ignore_errors=True)
        with contextlib.suppress(OSError, UserError):
            if _bare(path):
                (path / ABOUT).unlink(missing_ok=True)
                (path / "meta").rmdir()
        with contextlib.suppress(OSError):
            (path / _LOCK).unlink()
        os.close(lock)
        if made:
            with contextlib.suppress(OSError):  # the folder is not empty
                path.rmdir()


def schema_of(path: pathlib.Path) -> Schema:
    """Reads the schema of the data set in a folder.

    Raises:
        UserError: the folder holds no data set.
    """
    where = files.inside(path, *ABOUT.split("/"))
    if not where.exists():
        raise UserError(f"{path} holds no demonstrations of mjx_nero: give a folder that 'demos --out' wrote")
    return from_json(files.read_json(where), where)


def check(path: pathlib.Path, schema: Schema) -> None:
    """Checks that the folder is free, or holds a data set with the same schema.

    Raises:
        UserError: it holds something else, or is below a file.
    """
    if not path.exists():
        above = next(folder for folder in path.absolute().parents if folder.exists())
        if not above.is_dir():
            raise UserError(f"cannot write to {path}: {above.name} is a file; pass another folder")
        return
    if not path.is_dir():
        raise UserError(f"{path} is not a folder: pass another folder")
    if _bare(path):
        return
    if not files.inside(path, *ABOUT.split("/")).exists():
        raise UserError(f"{path} is not empty and holds no demonstrations: pass another folder")
    there, here = _flat(schema_of(path).to_json()), _flat(files.finite(schema.to_json()))
    if other := [name for name in here | there if here.get(name) != there.get(name)]:
        name = next((name for name in other if name.startswith("about.")), other[0])
        was, now = (short(each.get(name)) for each in (there, here))
        raise UserError(
            f"{path} holds other demonstrations ({name.removeprefix('about.')} was {was}, here it is {now}): "
            "pass another folder, or the same flags as before"
        )


def _bare(path: pathlib.Path) -> bool:
    """Returns whether a folder holds no more than what is written before the first episode."""
    held = {entry.name for entry in os.scandir(path)} - {_LOCK, PART}
    if held != {"meta"}:
        return not held
    meta = files.inside(path, "meta")
    return meta.is_dir() and all(f"meta/{name}" == ABOUT or name.startswith(".") for name in os.listdir(meta))


def _flat(value: Any, prefix: str = "") -> dict[str, Any]:
    """Returns values by dotted name, with tuples as lists."""
    if isinstance(value, Mapping):
        return {k: v for name, item in value.items() for k, v in _flat(item, f"{prefix}{name}.").items()}
    return {prefix[:-1]: _plain(value)}


def _plain(value: Any) -> Any:
    return [_plain(item) for item in value] if isinstance(value, list | tuple) else value


def commit(path: pathlib.Path, parts: Mapping[str, Write]) -> None:
    """Writes the files of a piece; the last one is the index.

    Args:
        parts: name within the folder -> function that writes the file.

    Raises:
        UserError: the piece cannot be written; then nothing of it remains.
    """
    made = []
    try:
        (path / PART).mkdir(exist_ok=True)
        for i, (name, write) in enumerate(parts.items()):
            part = path / PART / f"{i}{pathlib.Path(name).suffix}"
            write(part)
            files.sync(part)
            (path / name).parent.mkdir(parents=True, exist_ok=True)
            made.append((part, path / name))
        for part, place in made:
            part.replace(place)
        for folder in dict.fromkeys(place.parent for _, place in made):
            files.sync(folder)
    except OSError as error:
        raise UserError(
            f"cannot write to {path}: {_reason(error)}; everything written before is intact: "
            "make room, and repeat the command to continue"
        ) from None
    finally:
        shutil.rmtree(path / PART, ignore_errors=True)


def _reason(error: OSError) -> str:
    """Returns the system's reason, around which Arrow puts a long text."""
    return os.strerror(error.errno) if error.errno else str(error)
