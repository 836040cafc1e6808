"""Whole episodes played by a policy or a controller, and their figures."""
