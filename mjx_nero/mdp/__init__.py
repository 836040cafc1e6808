"""The terms that tasks are built of: pure functions of a ``View``."""
