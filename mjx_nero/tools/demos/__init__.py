"""The command ``demos``: data sets of demonstrations."""

from mjx_nero.tools.demos.command import main

__all__ = ["main"]
