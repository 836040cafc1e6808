"""Where compiled code is kept, on machines that let nothing be kept, and what heals by itself."""

import os
import pathlib
import zlib

import pytest

from mjx_nero import UserError
from mjx_nero.files import cache


def nowhere():
    raise RuntimeError("Could not determine home directory.")


def test_the_users_folder(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache.folder() == tmp_path / "mjx_nero"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(pathlib.Path, "home", lambda: tmp_path / "home")
    assert cache.folder() == tmp_path / "home" / ".cache" / "mjx_nero"


def test_no_home_and_a_home_that_cannot_be_written(monkeypatch, tmp_path):
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(cache.tempfile, "gettempdir", lambda: str(tmp_path))
    monkeypatch.setattr(pathlib.Path, "home", nowhere)
    assert cache.folder() == tmp_path / f"mjx_nero-{os.getuid()}"
    monkeypatch.setattr(pathlib.Path, "home", lambda: pathlib.Path("/proc"))
    assert cache.folder() == tmp_path / f"mjx_nero-{os.getuid()}"
    monkeypatch.setattr(cache.tempfile, "gettempdir", lambda: "/proc")
    assert cache.folder() is None


def test_truncated_entries_go(tmp_path):
    data = zlib.compress(os.urandom(3000))
    (tmp_path / "good-cache").write_bytes(data)
    (tmp_path / "bad-cache").write_bytes(data[:-40])
    (tmp_path / "empty-cache").write_bytes(b"")
    (tmp_path / "else").write_bytes(data[:10])
    cache.heal(tmp_path)
    assert {p.name for p in tmp_path.iterdir()} == {"good-cache", "else", ".looked"}
    (tmp_path / "later-cache").write_bytes(data[:-1])
    cache.heal(tmp_path)
    assert not (tmp_path / "later-cache").exists()
    cache.heal(tmp_path / "missing")


def test_too_few_addresses(monkeypatch):
    monkeypatch.setattr(cache.resource, "getrlimit", lambda _: (1_500_000_000, -1))
    with pytest.raises(UserError, match=r"^this process may use 1.5 GB of address space, JAX needs 2.5: raise the limit"):
        cache.check_addresses()
    monkeypatch.setattr(cache.resource, "getrlimit", lambda _: (-1, -1))
    cache.check_addresses()
