"""Robots, scenes, kinematics, physics and pictures: what MuJoCo knows."""
