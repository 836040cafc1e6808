"""How far a policy gets where the world is another than it was trained in: ``python -m mjx_nero robustness``."""

from mjx_nero.tools.robustness.command import main

__all__ = ["main"]
