"""The machine that figures were measured on."""

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

Row = dict[str, Any]  # one measurement, as JSON has it


def machine() -> Row:
    """Devices, processor, memory, system: nothing that names the machine or who uses it."""
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
    """Name for titles: the accelerators, or the processor without one."""
    many = f"{machine['devices']} x " if machine["devices"] > 1 else ""
    if machine["platform"] == "cpu":
        return f"{machine['cpu']}, {machine['cores']} cores"
    return f"{many}{machine['device']}"


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that decide a result, and the commit of a checkout."""
    found = machines.versions()
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

    with contextlib.suppress(subprocess.CalledProcessError, OSError):  # an empty repository, or one of another user
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
