"""Training runs: their config, their loop, and everything that they leave in their folder."""
