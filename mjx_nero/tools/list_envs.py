"""The command ``list-envs``."""

import dataclasses
from collections.abc import Sequence

from mjx_nero.learn import bundled
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
    """A row of ``list-envs``; ``robot`` is None if the environment takes any robot.

    Attributes:
        bundled: presets with a bundled policy of their own.
    """

    name: str
    robot: str | None
    presets: tuple[str, ...]
    bundled: tuple[str, ...]


def environments() -> tuple[Environment, ...]:
    """Lists all environments, without building scenes or tracing functions; sizes are shown by ``inspect``."""
    policies = bundled.names()
    out = []
    for name in registry.list_envs():
        robot, presets = registry.robot_of(name), registry.list_presets(name)
        own = tuple(preset for preset in presets if (name if preset == "default" else f"{name}_{preset}") in policies)
        out.append(Environment(name, robot.name if robot else None, presets, own))
    return tuple(out)


def environment_table(rows: Sequence[Environment]) -> console.Table:
    """Makes a table with one row per environment."""
    columns = ("name", "robot", "presets")
    view = console.Table("environments", columns, left=columns, wraps=columns[2:], caption="*: has a bundled policy")
    for row in rows:
        presets = (f"{preset}*" if preset in row.bundled else preset for preset in row.presets)
        view.add(row.name, row.robot or "any (--robot)", ", ".join(presets))
    return view
