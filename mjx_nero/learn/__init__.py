"""Policies and how they are trained and measured."""

import importlib
from typing import TYPE_CHECKING, Any

# Name of before 0.6 -> the module that it is now: code that imports it from here goes on.
_MOVED = {
    "evaluation": "play.evaluation",
    "ppo_cfg": "ppo.cfg",
    "rollout": "play.rollout",
    "run_cfg": "runs.cfg",
    "training": "runs.training",
}

if not TYPE_CHECKING:  # this package's own code says where a module lies

    def __getattr__(name: str) -> Any:
        if name not in _MOVED:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return importlib.import_module(f"{__name__}.{_MOVED[name]}")
