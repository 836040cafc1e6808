"""What a real arm's drives are, from a log of what they were told and where they went; what drives move, and how they answer.

``plant`` simulates an arm's drives, ``excitation`` gives targets that show all there is to find, ``log`` reads and writes what
was told and seen, ``fit`` finds the drives' parameters in it, ``simulate`` makes such logs. ``model``, ``load`` and ``response``
look at drives without a log. The commands ``record``, ``identify`` and ``tune-gains`` are in ``tools``.
"""

from mjx_nero.identify.fit import Fit, identify
from mjx_nero.identify.log import Log
from mjx_nero.identify.plant import Drives, Plant
from mjx_nero.identify.simulate import RecordCfg, record

__all__ = ["Drives", "Fit", "Log", "Plant", "RecordCfg", "identify", "record"]
