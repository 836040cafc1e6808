"""Imitation learning: from demonstrations (``clone``) or from a teacher (``distill``)."""
