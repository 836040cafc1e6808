"""Describes the machine on which figures are measured."""

import contextlib
import os
import pathlib
import platform
import re
import shutil
import subprocess
from importlib import metadata
from typing import Any

import jax

import mjx_nero
from mjx_nero.learn import machines

Row = dict[str, Any]  # one measurement, in JSON types


def machine() -> Row:
    """Returns devices, processor, memory and system, but nothing that identifies the machine or its user."""
    devices = jax.local_devices()
    return {
        "device": devices[0].device_kind,
        "devices": len(devices),
        "platform": devices[0].platform,
        "cpu": _cpu(),
        "cores": mjx_nero.cores(),
        "memory_gb": _memory_gb(),
        "os": _os(),
    }


def name(machine: Row) -> str:
    """Returns a name for titles: the accelerators, or the processor if there are none."""
    many = f"{machine['devices']} x " if machine["devices"] > 1 else ""
    if machine["platform"] == "cpu":
        return f"{machine['cpu']}, {machine['cores']} cores"
    return f"{many}{machine['device']}"


def versions() -> dict[str, str]:
    """Returns the versions of Python and of the packages that affect results, and the commit of a checkout."""
    found = {"mjx-nero": mjx_nero.__version__} | machines.versions()  # a checkout that is not installed has a version, too
    del found["device"]
    for package in ("jaxlib", "numpy"):
        found[package] = metadata.version(package)
    if commit := _commit():
        found["commit"] = commit
    return found


def _commit() -> str | None:
    root = pathlib.Path(mjx_nero.__file__).parents[1]
    if not (root / ".git").exists() or not shutil.which("git"):
        return None

    def git(*arguments: str) -> str:
        return subprocess.run(["git", "-C", str(root), *arguments], capture_output=True, text=True, check=True).stdout.strip()

    with contextlib.suppress(subprocess.CalledProcessError, OSError):  # an empty repository, or another user's
        return git("rev-parse", "HEAD") + (" with changes" if git("status", "--porcelain", "--untracked-files=no") else "")
    return None


def _cpu() -> str:
    with contextlib.suppress(OSError):
        if found := re.search(r"^model name\s*: (.+)$", pathlib.Path("/proc/cpuinfo").read_text(), re.MULTILINE):
            return found[1]
    return platform.processor() or platform.machine()


def _memory_gb() -> float | None:
    with contextlib.suppress(OSError, ValueError, AttributeError):
        return round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1)
    return None


def _os() -> str:
    with contextlib.suppress(OSError, AttributeError):
        return f"{platform.freedesktop_os_release()['PRETTY_NAME']}, {platform.system()} {platform.release()}"
    return f"{platform.system()} {platform.release()}"
