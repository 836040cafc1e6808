"""Policies that act on pictures: their networks, their ONNX graph, and PPO for them. ``imitation.distill`` trains them, too."""
