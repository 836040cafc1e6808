"""The command ``view``: environments in a browser, moving and to be moved."""
