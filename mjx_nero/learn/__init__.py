"""Training and evaluation of policies."""

import importlib
from typing import TYPE_CHECKING, Any

# Module names before 0.6 -> today's modules, so that older code can still import them from here.
_MOVED = {
    "evaluation": "mjx_nero.runs.evaluation",
    "ppo_cfg": "mjx_nero.learn.ppo.cfg",
    "rollout": "mjx_nero.learn.play.rollout",
    "run_cfg": "mjx_nero.runs.cfg",
    "training": "mjx_nero.runs.training",
}

if not TYPE_CHECKING:  # the package's own code imports the modules themselves

    def __getattr__(name: str) -> Any:
        if name not in _MOVED:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return importlib.import_module(_MOVED[name])
