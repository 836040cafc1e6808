"""Where LeRobot is, which wants its own versions of much."""

import os
import subprocess
import sys


def lerobot_python() -> str:
    """A Python that has lerobot: the one that MJX_NERO_LEROBOT_PYTHON names, or this one; empty: neither has."""
    found = os.environ.get("MJX_NERO_LEROBOT_PYTHON") or sys.executable
    have = subprocess.run([found, "-c", "import lerobot.datasets"], capture_output=True)
    return found if have.returncode == 0 else ""
