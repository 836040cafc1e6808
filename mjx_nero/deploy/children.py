"""Programs of this package in processes of their own."""

import os
import pathlib
import sys


def command(module: str, *argv: str) -> list[str]:
    """Returns the command that starts a module of this package."""
    return [sys.executable, "-m", module, *argv]


def environment() -> dict[str, str]:
    """Returns an environment in which a child finds the package that this process has."""
    root = str(pathlib.Path(__file__).resolve().parents[2])
    return {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, [root, os.environ.get("PYTHONPATH")]))}
