"""Compiled code kept between runs, where this user and this machine let files be kept."""

import contextlib
import os
import pathlib
import resource
import tempfile
import zlib

from mjx_nero.errors import UserError

_LEAST_ADDRESSES = 2.5e9  # bytes: below, XLA cannot start its threads, and aborts


def folder() -> pathlib.Path | None:
    """The user's cache folder; without a home that can be written to, a temporary one of this user's; None: nowhere."""
    wanted = [os.environ.get("XDG_CACHE_HOME")]
    with contextlib.suppress(RuntimeError):  # no HOME, and none that the system knows of
        wanted.append(str(pathlib.Path.home() / ".cache"))
    for parent in filter(None, wanted):
        if _writable(path := pathlib.Path(parent) / "mjx_nero"):
            return path
    path = pathlib.Path(tempfile.gettempdir()) / f"mjx_nero-{os.getuid()}"
    return path if _writable(path) and path.stat().st_uid == os.getuid() else None  # another user's may hold another's code


def heal(path: pathlib.Path) -> None:
    """Removes entries that a killed process left half-written: JAX would warn of them at every start, and never replace them.

    Looks at what is newer than the last look.
    """
    looked = path / ".looked"
    with contextlib.suppress(OSError):
        since = looked.stat().st_mtime if looked.exists() else 0.0
        looked.touch()
        for entry in path.glob("*-cache"):
            if entry.stat().st_mtime >= since and not _whole(entry.read_bytes()):
                entry.unlink()


def check_addresses() -> None:
    """Raises:
    UserError: this process may use too few addresses for JAX, which would abort without a word that helps.
    """
    most, _ = resource.getrlimit(resource.RLIMIT_AS)
    if 0 <= most < _LEAST_ADDRESSES:
        raise UserError(
            f"this process may use {most / 1e9:.1f} GB of addresses, and JAX needs {_LEAST_ADDRESSES / 1e9:g}: raise the limit "
            "(ulimit -v unlimited)"
        )


def _writable(path: pathlib.Path) -> bool:
    try:
        path.mkdir(parents=True, exist_ok=True, mode=0o700)
        with tempfile.TemporaryFile(dir=path):
            return True
    except OSError:
        return False


def _whole(entry: bytes) -> bool:
    """True unless the compressed data of an entry end too early. What JAX compresses with depends on what is installed."""
    if entry[:4] == b"\x28\xb5\x2f\xfd":  # Zstandard
        with contextlib.suppress(ImportError):
            import zstandard

            try:
                zstandard.ZstdDecompressor().decompress(entry)
            except zstandard.ZstdError:
                return False
        return True
    try:
        zlib.decompress(entry)
    except zlib.error:
        return False
    return True
