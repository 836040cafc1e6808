"""Plays and measures whole episodes, with a policy or a controller."""
