"""Solids made of mesh files: convex parts, mass, resting poses, and where a hand can grasp them. Nothing here knows a scene."""

from mjx_nero.sim.solids.solid import Solid
from mjx_nero.sim.solids.store import find, names

__all__ = ["Solid", "find", "names"]
