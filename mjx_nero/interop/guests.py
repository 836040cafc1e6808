"""Registers outside code: with one call, a user's file or package adds robots, environments, controllers and more."""

from collections.abc import Iterable, Mapping
from typing import Any

from mjx_nero import control
from mjx_nero.envs.task import Envs
from mjx_nero.learn import learner
from mjx_nero.sim import physics
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.tasks import registry


def register(
    *,
    robots: Iterable[RobotCfg] = (),
    envs: Envs | None = None,
    controllers: Mapping[str, tuple[Any, Any]] | None = None,
    physics_backends: Mapping[str, physics.Make] | None = None,
    learners: Mapping[str, learner.Kind] | None = None,
) -> None:
    """Registers things for ``make`` and for every command, which loads the file that calls this with ``--load``.

    Terms need no registration, because tasks refer to their functions directly.

    Args:
        robots: robots, each registered by its own name.
        envs: name -> (robot, preset -> factory of an ``EnvCfg``), as in the package's arms.
        controllers: name -> (class, its config), as in ``control.CONTROLLERS``.
        physics_backends: name -> ``(model, options, fields) -> Physics``.
        learners: name -> learner, for ``--learner``.

    Raises:
        UserError: a name is taken, or an environment or a learner lacks a preset.
    """
    for robot in robots:
        registry.ROBOTS.add(robot.name, robot)
    for name, env in (envs or {}).items():
        registry.add_env(name, *env)
    for name, controller in (controllers or {}).items():
        control.CONTROLLERS.add(name, controller)
    for name, backend in (physics_backends or {}).items():
        physics.BACKENDS.add(name, backend)
    for name, kind in (learners or {}).items():
        learner.add(name, kind)
