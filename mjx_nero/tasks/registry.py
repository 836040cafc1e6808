"""Robots and environments by name. Every module of ``arms`` adds its own."""

import contextlib
import dataclasses
import importlib
import pathlib
import pkgutil
from typing import TYPE_CHECKING, Any

from mjx_nero import config
from mjx_nero.config import values
from mjx_nero.config.registry import Registry, pick
from mjx_nero.envs import things
from mjx_nero.envs.task import EnvCfg, Envs, Presets
from mjx_nero.sim import contacts, robot_file
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.tasks import arms, fitted
from mjx_nero.types import UserError

if TYPE_CHECKING:
    from mjx_nero.envs.env import ManipulationEnv

_ARMS = [importlib.import_module(f"{arms.__name__}.{found.name}") for found in pkgutil.iter_modules(arms.__path__)]
_OWN: Envs = {name: entry for arm in _ARMS for name, entry in arm.ENVS.items()}
ROBOTS = Registry("robot", {arm.ROBOT.name: arm.ROBOT for arm in _ARMS})
ENVS = Registry("env", {**_OWN, **fitted.ENVS})  # with those for any robot that states its workspace


def add_env(name: str, robot: RobotCfg | None, presets: Presets) -> None:
    """Adds an environment: its robot (None: for any) and its presets, the default first.

    Every environment has a preset ``default``, which commands take if none is named. If none has that name, it is the first.

    Raises:
        UserError: the name is taken, or there is no preset.
    """
    if not presets:
        raise UserError(f"the environment {name!r} has no preset: give at least one")
    ENVS.add(name, (robot, {"default": next(iter(presets.values())), **presets}))


def list_envs() -> tuple[str, ...]:
    """Names that ``make`` takes."""
    return tuple(ENVS)


def list_presets(env: str) -> tuple[str, ...]:
    """Presets of an environment, the default first."""
    return tuple(ENVS.find(env)[1])


def list_robots() -> tuple[str, ...]:
    """Names of the package's own robots."""
    return tuple(ROBOTS)


def robot_of(env: str) -> RobotCfg | None:
    """An environment's own robot; None if it is for any."""
    return ENVS.find(env)[0]


def robot(name: str | pathlib.Path) -> RobotCfg:
    """A robot: one of the package's by name, or an imported one by its folder.

    Raises:
        UserError: the name is unknown, and not the folder of a robot.
    """
    return _find_robot(name)


def env_cfg(env: str, preset: str = "default", robot: RobotCfg | str | pathlib.Path | None = None, **overrides: Any) -> EnvCfg:
    """The config of an environment.

    Args:
        env: one of ``list_envs()``.
        preset: one of ``list_presets(env)``.
        robot: a robot other than the environment's own: a config, a name, or the folder of an imported one.
        overrides: fields by dotted name, as in ``**{"rewards.reaching_object.weight": 2.0}``.

    Raises:
        UserError: unknown name, preset, robot or field, or a value of the wrong type.
    """
    own, presets = ENVS.find(env)
    preset = values.read(str, preset, "preset")
    chosen = own if robot is None else robot if isinstance(robot, RobotCfg) else _find_robot(robot)
    if preset in list_robots() and preset not in presets:
        raise UserError(f"{preset!r} is a robot, not a preset of {env}: pass it as --robot")
    factory = pick(presets, preset, f"preset of {env}")
    if chosen is None:
        raise UserError(f"{env} is for any robot: pass one (--robot, a folder that import-urdf made, or {', '.join(ROBOTS)})")
    cfg = factory(chosen)
    cfg = dataclasses.replace(cfg, sim=cfg.sim.finer(cfg.robot.max_step))
    if chosen.folder:  # imported: its contacts have not been counted
        cfg = dataclasses.replace(cfg, sim=contacts.sized(chosen, cfg.scene, cfg.sim))
    return things.overridden(cfg, overrides)


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
        robot: a robot other than the environment's own: a config, a name, or the folder of an imported one.
        overrides: config fields by dotted name.

    Raises:
        UserError: unknown name, preset, impl, robot or field, or a value of the wrong type.
    """
    from mjx_nero.envs.env import ManipulationEnv  # imports Brax and MJX, which names and configs do not need

    return ManipulationEnv(env_cfg(env, preset, robot, **overrides), impl=impl, num_envs=num_envs)


def _find_robot(name: str | pathlib.Path) -> RobotCfg:
    if not isinstance(name, str | pathlib.Path):
        raise UserError(f"robot takes a config, a name or a folder, got {values.short(name)}")
    if str(name) in ROBOTS:
        return ROBOTS[str(name)]
    with contextlib.suppress(OSError):  # no file system has so long a name
        if pathlib.Path(name).is_dir():
            return robot_file.read(pathlib.Path(name))
    near = config.hint(str(name), ROBOTS)
    raise UserError(
        f"no robot {values.short(str(name))}{near}: choose one of {', '.join(ROBOTS)}, or give the folder of an imported one"
    )
