"""Tasks, arms, and the environment that runs them."""
