"""The commands ``record`` and ``identify``, for ``mjx_nero.identify`` (docs/guides/identification.md)."""

from mjx_nero.tools.identification.command import identify_main, record_main

__all__ = ["identify_main", "record_main"]
