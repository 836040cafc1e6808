"""Interfaces to other software: environments for Gymnasium and torch, policies for ONNX runtimes. Each part needs its extra."""

import importlib
from typing import Any

from mjx_nero.types import UserError


def missing(error: ModuleNotFoundError, extra: str) -> UserError:
    """Makes the error for an installation that lacks the module of an extra."""
    name = (error.name or "").partition(".")[0]
    return UserError(f"this needs {name}, of the extra {extra!r}: pip install 'mjx-nero[{extra}]'")


def need(module: str, extra: str) -> Any:
    """Imports a module of an extra.

    Raises:
        UserError: it is not installed.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        raise missing(error, extra) from None
