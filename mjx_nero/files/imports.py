"""Imports of packages without what they need only for others: seconds of every start."""

import contextlib
import importlib
import sys
import types
from collections.abc import Iterator, Mapping
from typing import Any


class Later(types.ModuleType):
    """Stands in for a module, and imports it when one of its attributes is first read."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):  # Python itself asks for those
            raise AttributeError(name)
        if sys.modules.get(self.__name__) is self:  # still hidden: only annotations read it
            return Any
        return getattr(importlib.import_module(self.__name__), name)


@contextlib.contextmanager
def replaced(stand_ins: Mapping[str, Any]) -> Iterator[None]:
    """Lets imports find stand-ins for modules that are not imported yet. A module that is None cannot be imported."""
    hidden = {name: stand_in for name, stand_in in stand_ins.items() if name not in sys.modules}
    sys.modules |= hidden
    try:
        yield
    finally:
        for name in hidden:
            del sys.modules[name]
