"""What a real arm's drives are, from a log of what they were told and where they went.

``record`` writes such a log of the simulated arm, ``identify`` fits the drives to one (docs/guides/identification.md).
"""

from mjx_nero.tools.identification.command import identify_main, record_main
from mjx_nero.tools.identification.fit import Fit, identify
from mjx_nero.tools.identification.log import Log
from mjx_nero.tools.identification.plant import Drives, Plant
from mjx_nero.tools.identification.simulate import RecordCfg, record

__all__ = ["Drives", "Fit", "Log", "Plant", "RecordCfg", "identify", "identify_main", "record", "record_main"]
