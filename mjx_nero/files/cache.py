"""The cache of compiled code between runs, if the user's and the machine's settings permit one."""

import contextlib
import os
import pathlib
import resource
import tempfile
import zlib

from mjx_nero.errors import UserError

_LEAST_ADDRESSES = 2.5e9  # bytes; with less address space XLA cannot start its threads and aborts


def folder() -> pathlib.Path | None:
    """Returns the user's cache folder, or the user's temporary one if the home is not writable; None if neither is writable."""
    wanted = [os.environ.get("XDG_CACHE_HOME")]
    with contextlib.suppress(RuntimeError):  # neither HOME nor the system's user database names a home
        wanted.append(str(pathlib.Path.home() / ".cache"))
    for parent in filter(None, wanted):
        if _writable(path := pathlib.Path(parent) / "mjx_nero"):
            return path
    path = pathlib.Path(tempfile.gettempdir()) / f"mjx_nero-{os.getuid()}"
    return (
        path if _writable(path) and path.stat().st_uid == os.getuid() else None
    )  # another user's folder may contain malicious code


def heal(path: pathlib.Path) -> None:
    """Removes entries that a killed process left incomplete: JAX would warn about them at every start and never replace them.

    Checks only entries that are newer than the last check.
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
    UserError: the limit on this process's address space is too low for JAX, which would abort without a helpful message.
    """
    most, _ = resource.getrlimit(resource.RLIMIT_AS)
    if 0 <= most < _LEAST_ADDRESSES:
        raise UserError(
            f"this process may use {most / 1e9:.1f} GB of address space, JAX needs {_LEAST_ADDRESSES / 1e9:g}: raise the limit "
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
    """Returns True unless an entry's compressed data ends too early. JAX compresses with zstandard if that is installed."""
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
