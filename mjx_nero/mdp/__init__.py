"""The terms of which tasks are built: pure functions of a ``View``."""
