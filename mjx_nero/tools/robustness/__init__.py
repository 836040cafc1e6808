"""Measures a policy's success in worlds that differ from its training: ``python -m mjx_nero robustness``."""

from mjx_nero.tools.robustness.command import main

__all__ = ["main"]
