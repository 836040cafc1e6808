"""Distillation: a student who sees learns from a teacher who knows. Its config, its networks and its learner."""
