"""One module an arm: its ``ROBOT``, the setups of its tasks, and its environments ``ENVS``. The registry finds them by itself."""
