"""Environments by name."""

from collections.abc import Callable
from typing import Any

from mjx_nero import config
from mjx_nero.env import EnvCfg, ManipulationEnv
from mjx_nero.robots import COBOTTA_PRO_900, NERO
from mjx_nero.tasks import follow_target, lift, pick_place
from mjx_nero.types import UserError

# name -> preset -> factory of a fresh config; the default preset first
_ENVS: dict[str, dict[str, Callable[[], EnvCfg]]] = {
    "nero_lift": {
        "default": lambda: lift.default(NERO, lift.NERO_WORK),
        "isaac": lambda: lift.isaac(NERO, lift.NERO_WORK),
    },
    "nero_follow_target": {
        "default": lambda: follow_target.default(NERO, follow_target.NERO_WORK),
        "static": lambda: follow_target.static(NERO, follow_target.NERO_WORK),
    },
    "nero_pick_place": {"default": lambda: pick_place.default(NERO, pick_place.NERO_WORK)},
    "cobotta_lift": {"default": lambda: lift.default(COBOTTA_PRO_900, lift.COBOTTA_WORK)},
    "cobotta_follow_target": {
        "default": lambda: follow_target.default(COBOTTA_PRO_900, follow_target.COBOTTA_WORK),
        "static": lambda: follow_target.static(COBOTTA_PRO_900, follow_target.COBOTTA_WORK),
    },
    "cobotta_pick_place": {"default": lambda: pick_place.default(COBOTTA_PRO_900, pick_place.COBOTTA_WORK)},
}


def list_envs() -> tuple[str, ...]:
    """Names that ``make`` takes."""
    return tuple(_ENVS)


def list_presets(env: str) -> tuple[str, ...]:
    """Presets of an environment, the default first."""
    return tuple(_pick(_ENVS, env, "env"))


def env_cfg(env: str, preset: str = "default", **overrides: Any) -> EnvCfg:
    """The config of an environment.

    Args:
        env: one of ``list_envs()``.
        preset: one of ``list_presets(env)``.
        overrides: fields by dotted name, as in ``**{"rewards.reaching_object.weight": 2.0}``.

    Raises:
        UserError: unknown name, preset or field, or a value of the wrong type.
    """
    return config.override(_pick(_pick(_ENVS, env, "env"), preset, f"preset of {env}")(), overrides)


def make(env: str, preset: str = "default", impl: str = "auto", num_envs: int = 1, **overrides: Any) -> ManipulationEnv:
    """Makes an environment.

    Args:
        env: one of ``list_envs()``.
        preset: one of ``list_presets(env)``.
        impl: physics, ``auto``, ``jax`` or ``warp``.
        num_envs: how many copies will be stepped together (sizes Warp's buffers).
        overrides: config fields by dotted name.

    Raises:
        UserError: unknown name, preset, impl or field, or a value of the wrong type.
    """
    return ManipulationEnv(env_cfg(env, preset, **overrides), impl=impl, num_envs=num_envs)


def _pick(table: dict, name: str, what: str) -> Any:
    if name not in table:
        raise UserError(f"unknown {what} {name!r}{config.hint(name, table)}: choose one of {', '.join(table)}")
    return table[name]
