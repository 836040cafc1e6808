"""One module per arm: its ``ROBOT``, its task setups, and its environments ``ENVS``. The registry finds the modules itself."""
