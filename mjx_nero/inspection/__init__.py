"""What a robot or an environment is made of: python -m mjx_nero inspect nero --move --render nero.png"""

from mjx_nero.inspection.contacts import constraint_rows, contact_pairs
from mjx_nero.inspection.motion import moves
from mjx_nero.inspection.report import draw, environments, find, inspect, inspect_robot
from mjx_nero.inspection.tables import environment_table, move_table, tables

__all__ = [
    "constraint_rows",
    "contact_pairs",
    "draw",
    "environment_table",
    "environments",
    "find",
    "inspect",
    "inspect_robot",
    "move_table",
    "moves",
    "tables",
]
