"""The PPO learner: its config, networks and training loop."""
