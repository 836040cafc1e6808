"""Outside code as a guest with the same rights: one call registers what a file or a package of its own brings."""

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
    """Makes a guest's things known to ``make`` and to every command (their ``--load`` reads the file that calls this).

    Terms need no registration: a task names its functions.

    Args:
        robots: by their own names.
        envs: name -> (robot, preset -> factory of an ``EnvCfg``), as the package's arms have them.
        controllers: name -> (class, its config), as in ``control.CONTROLLERS``.
        physics_backends: name -> ``(model, options, fields) -> Physics``.
        learners: for ``--learner``.

    Raises:
        UserError: a name is taken.
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
        learner.KINDS.add(name, kind)
