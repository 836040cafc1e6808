"""Distillation: a student with cameras learns from a teacher that is told the state. Its config, networks and learner."""
