"""URDF import: ``import_urdf`` writes a model folder that ``mjx_nero.make`` takes as a robot."""

from mjx_nero.urdf.importer import import_urdf
from mjx_nero.urdf.report import Report

__all__ = ["Report", "import_urdf"]
