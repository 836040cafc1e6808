"""Distillation: a student with cameras learns from a teacher that observes the state. Config, networks and learner."""
