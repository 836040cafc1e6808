"""Starts programs of this package in separate processes."""

import os
import pathlib
import sys


def command(module: str, *argv: str) -> list[str]:
    """Returns the command that starts a module of this package."""
    return [sys.executable, "-m", module, *argv]


def environment() -> dict[str, str]:
    """Returns environment variables with which a child process finds the same package as this process."""
    root = str(pathlib.Path(__file__).resolve().parents[2])
    return {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, [root, os.environ.get("PYTHONPATH")]))}
