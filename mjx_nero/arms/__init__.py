"""One module an arm: its ``ROBOT``, its work, and its environments ``ENVS``. The registry finds them by itself."""
