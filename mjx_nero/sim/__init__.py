"""Robots, scenes, kinematics, physics and pictures: everything that builds on MuJoCo."""
