"""The command ``deploy``: an exported policy on an arm, real, emulated or simulated, behind the safety layer."""

from mjx_nero.tools.deploy.command import FAULT, main

__all__ = ["FAULT", "main"]
