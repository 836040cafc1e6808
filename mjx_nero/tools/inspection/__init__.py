"""Tables and pictures of a robot or an environment: python -m mjx_nero inspect nero --move --render nero.png"""

from mjx_nero.sim.contacts import constraint_rows, contact_pairs
from mjx_nero.tools.inspection.report import find, inspect, inspect_robot, picture
from mjx_nero.tools.inspection.tables import move_table, tables
from mjx_nero.tools.motion import moves

__all__ = [
    "constraint_rows",
    "contact_pairs",
    "find",
    "inspect",
    "inspect_robot",
    "move_table",
    "moves",
    "picture",
    "tables",
]
