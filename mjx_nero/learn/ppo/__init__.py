"""PPO: its config, its networks and its learner."""
