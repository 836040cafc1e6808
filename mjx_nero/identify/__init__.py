"""Identifies the drives of a real arm from a log of their targets and motions."""

from mjx_nero.identify.fit import Fit, identify
from mjx_nero.identify.log import Log
from mjx_nero.identify.plant import Drives, Plant, usual_step
from mjx_nero.identify.simulate import RecordCfg, record

__all__ = ["Drives", "Fit", "Log", "Plant", "RecordCfg", "identify", "record", "usual_step"]
