"""Safe file access: files are written whole or not at all, and read with limits, since they may come from an untrusted source."""

import contextlib
import fcntl
import functools
import glob
import json
import math
import os
import pathlib
import re
import shutil
import stat
import time
import zlib
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, BinaryIO, NoReturn

from mjx_nero.errors import UserError

if TYPE_CHECKING:  # whoever reads neither XML nor YAML needs no parser of them, such as an exported policy
    from lxml import etree

    from mjx_nero.files.yaml_loader import YamlLoader

TRIES = 5  # attempts to write a file whose folder is removed meanwhile
PART = ".part"  # in the name of a file that is still being written
SILENT = 86_400.0  # [s] without a write, after which a part of another machine is left over
MAX_TAGS = 400_000  # elements and attributes in an XML file
MAX_YAML = 200_000  # bytes
MAX_NODES = 20_000  # values in a YAML file, with aliases expanded
MAX_DEPTH = 12  # levels of nesting in a YAML file
MAX_JSON = 4_000_000  # bytes
MAX_JSON_DEPTH = 30
# Marks of kinds of files that are the same whoever writes them.
MARKS = {".png": b"\x89PNG", ".pdf": b"%PDF", ".svg": b"<svg", ".mp4": b"ftyp", ".onnx": b"mjx_nero"}
# Errors of libxml2 about <?xml ...?> alone: a version such as "1" or "0.0", none at all, or a line before it.
_MISDECLARED = ("ERR_UNKNOWN_VERSION", "ERR_VERSION_MISSING", "ERR_XMLDECL_NOT_STARTED", "ERR_RESERVED_XML_NAME")


@contextlib.contextmanager
def open_file(path: pathlib.Path) -> Iterator[tuple[BinaryIO, int]]:
    """Opens a regular file for reading; yields it and its size in bytes.

    Raises:
        UserError: there is no such file, or it cannot be read.
    """
    try:
        handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)  # O_NONBLOCK: opening a pipe would wait for a writer
        try:
            status = os.fstat(handle)
            if not stat.S_ISREG(status.st_mode):
                raise UserError(f"{path} is not a file")
            with open(handle, "rb", closefd=False) as file:
                yield file, status.st_size
        finally:
            os.close(handle)
    except FileNotFoundError:
        raise UserError(f"there is no file {path}") from None
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror or error}") from None
    except ValueError as error:
        if "\0" not in str(path):
            raise
        raise UserError(f"cannot read {path}: {error}") from None


def read_bytes(path: pathlib.Path, limit: int) -> bytes:
    """Reads a regular file.

    Raises:
        UserError: there is no such file, it cannot be read, or it is larger than ``limit`` bytes.
    """
    with open_file(path) as (file, size):
        content = file.read(limit + 1) if size <= limit else b""
    size = max(size, len(content))
    if size > limit:
        raise UserError(f"{path} has {size / 1e6:.3g} MB: more than {limit / 1e6:.3g} MB are not read")
    return content


def inside(folder: pathlib.Path, *names: str) -> pathlib.Path:
    """Returns the path ``folder/name/name`` inside an untrusted folder, whether it exists or not.

    Raises:
        UserError: a part of the path is a link, or is neither a regular file nor a folder.
    """
    path = folder
    for name in names:
        path = path / name
        try:
            mode = os.lstat(path).st_mode
        except (FileNotFoundError, NotADirectoryError):
            continue
        except (OSError, ValueError) as error:
            raise UserError(f"cannot read {path}: {getattr(error, 'strerror', None) or error}") from None
        if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
            what = "a link" if stat.S_ISLNK(mode) else "not a regular file"
            raise UserError(f"{path} is {what} and will not be read or written: remove it, or copy {folder} without it")
    return path


def read_json(path: pathlib.Path, limit: int = MAX_JSON) -> Any:
    """Reads a JSON file of plain values with unique keys and finite numbers.

    Raises:
        UserError: as in ``read_bytes``; or it is not such JSON.
    """
    content = read_bytes(path, limit)
    try:
        return parse_json(content)
    except (ValueError, RecursionError) as error:
        what = "too deep" if isinstance(error, RecursionError) else " ".join(str(error).split())[:160]
        raise UserError(f"{path} is not JSON: {what}") from None


def parse_json(text: str | bytes) -> Any:
    """Parses strict JSON: keys are unique and numbers finite.

    Raises:
        ValueError, RecursionError: the text is not strict JSON, or is nested too deeply.
    """
    found = json.loads(text, object_pairs_hook=_once, parse_constant=_refuse, parse_float=_finite, parse_int=_whole_number)
    level = [found]
    for _ in range(MAX_JSON_DEPTH):
        inner = (value.values() if isinstance(value, dict) else value for value in level if isinstance(value, dict | list))
        level = [item for items in inner for item in items]
    if level:
        raise ValueError(f"deeper than {MAX_JSON_DEPTH} levels")
    return found


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    out = dict(pairs)
    if len(out) != len(pairs):
        raise ValueError("a key occurs twice")
    return out


def _refuse(text: str) -> NoReturn:
    raise ValueError(f"{text} is not a number that can be read")


def _finite(text: str) -> float:
    return float(text) if math.isfinite(float(text)) else _refuse(text[:40])


def _whole_number(text: str) -> int:
    return int(text) if len(text) <= 20 else _refuse(f"{text[:40]}...")


def parse_xml(content: bytes, name: str) -> "etree._Element":
    """Returns the root element. Reads neither entities nor other files. Undeclared prefixes stay in the tags (``a:b``).

    Raises:
        UserError: the XML is malformed, has more than ``MAX_TAGS`` elements and attributes, or declares a document type, which
            entity bombs need but models and meshes do not.
    """
    from lxml import etree

    tags = content.count(b"<") + content.count(b"=")  # libxml2 needs hundreds of bytes for each
    if tags > MAX_TAGS:
        raise UserError(f"{name} has about {tags:,} elements and attributes: more than {MAX_TAGS:,} are not read")
    parser = _parser()
    try:
        root = etree.fromstring(content, parser, base_url=name)
    except (etree.XMLSyntaxError, ValueError) as error:
        log = parser.error_log  # the exception's own log may contain errors of other files
        if (plain := _declared(content)) != content and any(entry.type_name in _MISDECLARED for entry in log):
            return parse_xml(plain, name)
        if not log or any(entry.domain_name != "NAMESPACE" for entry in log):
            raise UserError(f"{name} is not well-formed XML: {error}") from None
        root = etree.fromstring(content, _parser(recover=True), base_url=name)  # only prefixes are undeclared
    if root.getroottree().docinfo.internalDTD is not None:
        raise UserError(f"{name} declares a document type (<!DOCTYPE ...>): remove it, a robot description needs none")
    return root


def _declared(content: bytes) -> bytes:
    """Returns the XML with a correct declaration at its start, if it has one: robots are published with others."""
    if not (found := re.search(rb"<\?xml\s[^>]*\?>", content)):
        return content
    coding = re.search(rb"encoding\s*=\s*[\"']([\w.-]+)", found[0])
    first = b'<?xml version="1.0" encoding="%s"?>' % (coding[1] if coding else b"UTF-8")
    return first + content[: found.start()] + content[found.end() :]


def _parser(recover: bool = False) -> "etree.XMLParser":
    from lxml import etree

    return etree.XMLParser(resolve_entities=False, load_dtd=False, no_network=True, huge_tree=False, recover=recover)


def read_yaml(path: pathlib.Path, loader: type["YamlLoader"] | None = None) -> Any:
    """Reads a YAML file as mappings, lists, strings, numbers, booleans and None; keys are strings, as written.

    Args:
        loader: a subclass of ``YamlLoader`` that knows more tags.

    Raises:
        UserError: as in ``read_bytes``; or it is not YAML, a key occurs twice, or it has more than ``MAX_NODES`` values or
            ``MAX_DEPTH`` levels.
    """
    import yaml

    from mjx_nero.files.yaml_loader import YamlLoader

    content = read_bytes(path, MAX_YAML)
    try:
        return (loader or YamlLoader)(content).get_single_data()
    # Constructors raise various exceptions.
    except (yaml.YAMLError, ValueError, LookupError, TypeError, ArithmeticError, RecursionError) as error:
        mark = getattr(error, "problem_mark", None)
        where = f" in line {mark.line + 1}" if mark else ""
        what = " ".join((getattr(error, "problem", None) or str(error)).split())[:160]
        raise UserError(f"{path} is not YAML{where}: {what or type(error).__name__}") from None


def check_writable(path: pathlib.Path, marks: Sequence[str] = ()) -> None:
    """Checks before long work that its result can be written to a file, by writing an empty one beside it.

    A file that exists is only replaced by another of its kind.

    Args:
        marks: texts of which every file of this kind holds one; none: it is known by its suffix, or may be any.

    Raises:
        UserError: it is a folder, or of another kind, or its folder does not exist or is not writable.
    """
    if path.is_dir():
        raise UserError(f"cannot write {path}: it is a folder, give a file name")
    _check_kind(path, [mark.encode() for mark in marks] or [MARKS.get(path.suffix.lower(), b"")])
    part = _part(path)
    try:
        part.touch()
        part.unlink()
    except OSError as error:
        missing = f"{path.parent} is a file" if path.parent.exists() else f"the folder {path.parent} does not exist"
        why = error.strerror or error if path.parent.is_dir() else missing
        raise UserError(f"cannot write {path}: {why}") from None


def _check_kind(path: pathlib.Path, marks: Sequence[bytes]) -> None:
    if path.exists():
        with open_file(path) as (file, size):
            start = file.read(MAX_JSON)
        if size and not any(mark in start for mark in marks):
            raise UserError(f"cannot write {path}: it exists and is another kind of file, remove it or name another")


class _FolderRemoved(UserError):
    """A folder was removed while a file was written into it."""


@contextlib.contextmanager
def whole(path: pathlib.Path) -> Iterator[pathlib.Path]:
    """Yields a path to write to; the file then appears whole or not at all, even if the power fails. Creates its folder.

    Raises:
        UserError: it cannot be written.
    """
    part = _part(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _tidy(path)  # a link there would redirect the write
        yield part
        sync(part)
        part.replace(path)
        sync(path.parent)
    except (OSError, ValueError) as error:  # ValueError: the writing library does not know this file type
        if isinstance(error, UserError):
            raise
        kind = _FolderRemoved if isinstance(error, FileNotFoundError) else UserError
        raise kind(f"cannot write {path}: {getattr(error, 'strerror', None) or error}") from None
    finally:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)


def _part(path: pathlib.Path) -> pathlib.Path:
    """Returns where this process writes a file before the file appears: two that write the same file have two places."""
    return path.with_name(f"{_head(path)}{os.getpid()}-{_here()}{PART}{path.suffix}")


def _head(path: pathlib.Path) -> str:
    return f".{path.stem[:40]}."  # a name must not become too long by what is added to it


@functools.cache
def _here() -> str:
    """Returns what tells this machine, and on it this container, from others that write to the same disk."""
    with contextlib.suppress(OSError):  # no /proc
        return f"{zlib.crc32((os.uname().nodename + os.readlink('/proc/self/ns/pid')).encode()):08x}"
    return f"{zlib.crc32(os.uname().nodename.encode()):08x}"


def _tidy(path: pathlib.Path) -> None:
    """Removes what killed processes, or an enemy who knew our number, left at the parts of a file."""
    head, own = _head(path), _part(path)
    for left in path.parent.glob(f"{glob.escape(head)}*{PART}*"):
        owner = re.fullmatch(rf"(\d{{1,9}})-(\w{{8}}){PART}.*", left.name[len(head) :])
        if left == own or owner and not _runs(int(owner[1]), owner[2], left):
            left.unlink(missing_ok=True)


def _runs(process: int, where: str, part: pathlib.Path) -> bool:
    """Returns whether a part's process may still run. On another machine it counts as ended once the part is a day old."""
    if where != _here():
        with contextlib.suppress(FileNotFoundError):
            return time.time() - part.lstat().st_mtime < SILENT
        return False
    try:
        os.kill(process, 0)
    except OSError as error:
        return not isinstance(error, ProcessLookupError)  # another user's process may not be asked
    return True


def write(path: pathlib.Path, data: bytes) -> None:
    """Writes a file, whole or not at all; tries again if its folder is removed meanwhile.

    Raises:
        UserError: it cannot be written.
    """
    for left in reversed(range(TRIES)):
        try:
            with whole(path) as part:
                part.write_bytes(data)
            return
        except _FolderRemoved:
            if not left:
                raise


def own(path: pathlib.Path) -> None:
    """Replaces a file that has hard links elsewhere by its own copy, before something is appended to it in place.

    Raises:
        UserError: it cannot be copied.
    """
    with contextlib.suppress(FileNotFoundError):
        status = os.lstat(path)
        if stat.S_ISREG(status.st_mode) and status.st_nlink > 1:
            with whole(path) as part:
                shutil.copyfile(path, part)


def write_json(path: pathlib.Path, value: Any) -> None:
    """Writes JSON that every reader accepts: non-finite numbers become null, and objects that JSON does not know become strings.

    Raises:
        UserError: it cannot be written.
    """
    write(path, (json.dumps(finite(value), indent=2, allow_nan=False, default=str) + "\n").encode())


def finite(value: Any) -> Any:
    """Returns ``value`` with every non-finite number replaced by None."""
    if isinstance(value, Mapping):
        return {name: finite(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def lock(path: pathlib.Path) -> int:
    """Opens and locks a file; returns its handle. The lock lasts until the handle is closed or this process ends.

    Raises:
        UserError: another process holds the lock.
        OSError: the file cannot be created.
    """
    while True:
        handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK, 0o644)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            owner = os.read(handle, 100).decode(errors="replace").strip()
            os.close(handle)
            raise UserError(
                f"{path.parent} is in use by {owner or 'another process'}: wait until it ends, or pass another --out"
            ) from None
        except OSError:
            return handle  # the file system has no locks
        with contextlib.suppress(FileNotFoundError):
            if os.fstat(handle).st_nlink > 1:  # a hard link to someone else's file
                path.unlink()
            elif os.stat(path).st_ino == os.fstat(handle).st_ino:  # otherwise the owner removed it just before it was locked
                os.truncate(handle, 0)
                os.write(handle, f"process {os.getpid()} on {os.uname().nodename}\n".encode())
                return handle
        os.close(handle)


def sync(path: pathlib.Path) -> None:
    """Waits until a file, or a folder's list of files, is stored on the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
