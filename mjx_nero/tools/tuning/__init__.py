"""Proposes gains for a robot's drives: python -m mjx_nero tune-gains --robot nero --out gains.yaml --plot gains.png

The simulation uses MuJoCo's C library, without contacts and without a limit on the targets' speed, so that it shows the drives
alone. ``proposal`` chooses gains for the ``load`` that each drive has to move; ``response`` measures step responses.
"""

from mjx_nero.identify.load import Load, loads
from mjx_nero.identify.model import drives_model
from mjx_nero.identify.response import Response, respond, steps
from mjx_nero.tools.tuning.command import main
from mjx_nero.tools.tuning.proposal import Tuning, gains, propose, tune
from mjx_nero.tools.tuning.report import plot, table

__all__ = [
    "Load",
    "Response",
    "Tuning",
    "drives_model",
    "gains",
    "loads",
    "main",
    "plot",
    "propose",
    "respond",
    "steps",
    "table",
    "tune",
]
