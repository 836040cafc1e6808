"""The command ``view``: environments in a browser, moving and to be moved."""

from mjx_nero.tools.view.command import View, main, open_view, serve

__all__ = ["View", "main", "open_view", "serve"]
