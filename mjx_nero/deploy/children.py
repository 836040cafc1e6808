"""Programs of this package in processes of their own."""

import os
import pathlib
import sys


def command(module: str, *argv: str) -> list[str]:
    """What starts a module of this package."""
    return [sys.executable, "-m", module, *argv]


def environment() -> dict[str, str]:
    """In which it finds the package that this process has."""
    root = str(pathlib.Path(__file__).resolve().parents[2])
    return {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, [root, os.environ.get("PYTHONPATH")]))}
