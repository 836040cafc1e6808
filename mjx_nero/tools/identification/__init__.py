"""The commands ``record`` and ``identify`` (docs/guides/identification.md): ``mjx_nero.identify`` at a command line."""

from mjx_nero.tools.identification.command import identify_main, record_main

__all__ = ["identify_main", "record_main"]
