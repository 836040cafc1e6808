"""Objects from files: meshes cut into convex parts, their mass, how they rest, and where a hand can grasp them."""

from mjx_nero.sim.objects import body
from mjx_nero.sim.objects.solid import Solid
from mjx_nero.sim.objects.store import find, names

__all__ = ["Solid", "body", "find", "names"]
