"""Interfaces to other software: environments for Gymnasium and torch, policies for ONNX runtimes. Each part needs its extra."""

import importlib
from typing import Any

from mjx_nero.errors import UserError, missing


def need(module: str) -> Any:
    """Imports a module of an extra.

    Raises:
        UserError: it is not installed.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        raise UserError(missing(error)) from None
