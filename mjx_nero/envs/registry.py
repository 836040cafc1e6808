"""Robots and environments by name. Every module of ``arms`` brings its own."""

import contextlib
import dataclasses
import importlib
import pathlib
import pkgutil
from typing import TYPE_CHECKING, Any

from mjx_nero import config
from mjx_nero.config import values
from mjx_nero.envs import arms, fitted
from mjx_nero.envs.task import EnvCfg, Envs, Presets
from mjx_nero.sim import contacts, robot_file
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.types import UserError

if TYPE_CHECKING:
    from mjx_nero.envs.env import ManipulationEnv

_ARMS = [importlib.import_module(f"{arms.__name__}.{found.name}") for found in pkgutil.iter_modules(arms.__path__)]
_ROBOTS: dict[str, RobotCfg] = {arm.ROBOT.name: arm.ROBOT for arm in _ARMS}
_ENVS: Envs = {name: entry for arm in _ARMS for name, entry in arm.ENVS.items()}
_ENVS |= fitted.ENVS  # for any robot that states its workspace


def register_robot(robot: RobotCfg) -> None:
    """Adds a robot under its own name.

    Raises:
        UserError: there is one of this name.
    """
    _add(_ROBOTS, robot.name, robot, "robot")


def register_env(name: str, robot: RobotCfg | None, presets: Presets) -> None:
    """Adds an environment: its robot (None: for any) and its presets, the default first.

    Raises:
        UserError: there is one of this name, or it has no preset.
    """
    if not presets:
        raise UserError(f"the environment {name!r} has no preset: give at least one")
    _add(_ENVS, name, (robot, presets), "environment")


def _add(table: dict, name: str, thing: Any, what: str) -> None:
    if name in table:
        raise UserError(f"there is a{'n' * (what[0] in 'aeiou')} {what} {name!r} already: choose another name")
    table[name] = thing


def list_envs() -> tuple[str, ...]:
    """Names that ``make`` takes."""
    return tuple(_ENVS)


def list_presets(env: str) -> tuple[str, ...]:
    """Presets of an environment, the default first."""
    return tuple(_pick(_ENVS, env, "env")[1])


def list_robots() -> tuple[str, ...]:
    """Names of the package's own robots."""
    return tuple(_ROBOTS)


def robot_of(env: str) -> RobotCfg | None:
    """An environment's own robot; None if it is for any."""
    return _pick(_ENVS, env, "env")[0]


def robot(name: str | pathlib.Path) -> RobotCfg:
    """A robot: one of the package's by name, or an imported one by its folder.

    Raises:
        UserError: unknown name, or no folder of a robot.
    """
    return _find_robot(name)


def env_cfg(env: str, preset: str = "default", robot: RobotCfg | str | pathlib.Path | None = None, **overrides: Any) -> EnvCfg:
    """The config of an environment.

    Args:
        env: one of ``list_envs()``.
        preset: one of ``list_presets(env)``.
        robot: another than the environment's own: a config, a name or the folder of an imported one.
        overrides: fields by dotted name, as in ``**{"rewards.reaching_object.weight": 2.0}``.

    Raises:
        UserError: unknown name, preset, robot or field, or a value of the wrong type.
    """
    own, presets = _pick(_ENVS, env, "env")
    preset = values.read(str, preset, "preset")
    chosen = own if robot is None else robot if isinstance(robot, RobotCfg) else _find_robot(robot)
    if preset in list_robots() and preset not in presets:
        raise UserError(f"{preset!r} is a robot, not a preset of {env}: pass it as --robot")
    factory = _pick(presets, preset, f"preset of {env}")
    if chosen is None:
        raise UserError(f"{env} is for any robot: pass one (--robot, a folder that import-urdf made, or {', '.join(_ROBOTS)})")
    cfg = factory(chosen)
    cfg = dataclasses.replace(cfg, sim=cfg.sim.finer(cfg.robot.max_step))
    if chosen.folder:  # imported: nobody has counted the contacts that its work makes
        cfg = dataclasses.replace(cfg, sim=contacts.sized(chosen, cfg.scene, cfg.sim))
    return config.override(cfg, overrides)


def make(
    env: str,
    preset: str = "default",
    impl: str = "auto",
    num_envs: int = 1,
    robot: RobotCfg | str | pathlib.Path | None = None,
    **overrides: Any,
) -> "ManipulationEnv":
    """Makes an environment.

    Args:
        env: one of ``list_envs()``.
        preset: one of ``list_presets(env)``.
        impl: physics, one of ``physics.impls()``.
        num_envs: how many copies will be stepped together (as in ``ManipulationEnv``).
        robot: another than the environment's own: a config, a name or the folder of an imported one.
        overrides: config fields by dotted name.

    Raises:
        UserError: unknown name, preset, impl, robot or field, or a value of the wrong type.
    """
    from mjx_nero.envs.env import ManipulationEnv  # with Brax and MJX, which names and configs do without

    return ManipulationEnv(env_cfg(env, preset, robot, **overrides), impl=impl, num_envs=num_envs)


def _find_robot(name: str | pathlib.Path) -> RobotCfg:
    if not isinstance(name, str | pathlib.Path):
        raise UserError(f"robot takes a config, a name or a folder, got {values.short(name)}")
    if str(name) in _ROBOTS:
        return _ROBOTS[str(name)]
    with contextlib.suppress(OSError):  # no file system has so long a name
        if pathlib.Path(name).is_dir():
            return robot_file.read(pathlib.Path(name))
    near = config.hint(str(name), _ROBOTS)
    raise UserError(
        f"no robot {values.short(str(name))}{near}: choose one of {', '.join(_ROBOTS)}, or give the folder of an imported one"
    )


def _pick(table: Any, name: str, what: str) -> Any:
    if values.read(str, name, what) not in table:
        raise UserError(f"unknown {what} {values.short(name)}{config.hint(name, table)}: choose one of {', '.join(table)}")
    return table[name]
