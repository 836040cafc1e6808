"""The command ``view``: shows environments in a browser and lets the user take part."""
