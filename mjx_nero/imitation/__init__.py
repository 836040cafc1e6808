"""Learners that learn from somebody who can do the task: from demonstrations (``clone``) or from a teacher (``distill``)."""
