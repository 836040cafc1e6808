"""Expands xacro to URDF with the package's own expander, so that an untrusted file can only calculate.

The usual implementation passes expressions to Python's ``eval`` and opens whatever a file names. Here expressions are walked node
by node (``evaluate``), with the functions and methods of one table (``functions``). Files are found only within the given folders
(``files.Roots``), and one budget bounds time and memory (``budget``).
"""

from mjx_nero.urdf.xacro.expander import expand, is_xacro

__all__ = ["expand", "is_xacro"]
