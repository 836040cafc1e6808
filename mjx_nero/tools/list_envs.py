"""The command ``list-envs``."""

import dataclasses
import pkgutil
from collections.abc import Sequence

from mjx_nero import tasks
from mjx_nero.learn.bundled import shipped
from mjx_nero.runs import console
from mjx_nero.tasks import registry
from mjx_nero.tools import cli


def main(argv: Sequence[str]) -> None:
    """The command line."""
    parser = cli.Parser("list-envs", "Lists the environments. To show one of them, use inspect NAME.")
    parser.add_load()
    parser.parse(argv)
    console.screen().print(environment_table(environments()))


@dataclasses.dataclass(frozen=True)
class Environment:
    """A row of ``list-envs``; ``robot`` is None if the environment takes any robot."""

    name: str
    task: str
    robot: str | None
    presets: tuple[str, ...]
    policy: bool


def environments() -> tuple[Environment, ...]:
    """Lists all environments, without building scenes or tracing functions; sizes are shown by ``inspect``."""
    known = [module.name for module in pkgutil.iter_modules(tasks.__path__)]
    out = []
    for name in registry.list_envs():
        task, robot = next((task for task in known if name.endswith(task)), name), registry.robot_of(name)
        bundled = robot is not None and shipped(name).is_file()
        out.append(Environment(name, task, robot.name if robot else None, registry.list_presets(name), bundled))
    return tuple(out)


def environment_table(rows: Sequence[Environment]) -> console.Table:
    """Makes a table with one row per environment."""
    columns = ("name", "task", "robot", "presets", "policy")
    view = console.Table("environments", columns, left=columns)
    for row in rows:
        view.add(row.name, row.task, row.robot or "any (--robot)", ", ".join(row.presets), "bundled" if row.policy else "")
    return view
