"""The command ``deploy``: runs an exported policy on a real, emulated or simulated arm, behind the safety layer."""

from mjx_nero.tools.deploy.command import FAULT, main

__all__ = ["FAULT", "main"]
