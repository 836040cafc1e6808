"""What a model needs before it learns: python -m mjx_nero COMMAND ... (each has its --help)."""

import importlib
from collections.abc import Sequence

from mjx_nero import cli, config
from mjx_nero.types import UserError

# command -> (module, function of the arguments, what it does)
COMMANDS = {
    "list-envs": ("mjx_nero.inspection.command", "list_envs_main", "the environments: task, robot, sizes"),
    "inspect": (
        "mjx_nero.inspection.command",
        "main",
        "a robot, a model folder or an environment: joints, gains, contacts",
    ),
    "import-urdf": ("mjx_nero.urdf.command", "main", "a model folder from a URDF"),
    "tune-gains": ("mjx_nero.tuning", "main", "stiffness and damping from step responses"),
}


def main(argv: Sequence[str]) -> None:
    """Hands the arguments to a command."""
    lines = "\n".join(f"  {name:<12} {what}" for name, (_, _, what) in COMMANDS.items())
    if not argv or argv[0] in ("-h", "--help"):
        print(f"usage: python -m mjx_nero COMMAND ...\n\ncommands:\n{lines}")
        if not argv:
            raise UserError(f"name a command: {', '.join(COMMANDS)}")
        return
    if argv[0] not in COMMANDS:
        raise UserError(f"unknown command {argv[0]!r}{config.hint(argv[0], COMMANDS)}: choose one of {', '.join(COMMANDS)}")
    module, function, _ = COMMANDS[argv[0]]
    getattr(importlib.import_module(module), function)(argv[1:])


if __name__ == "__main__":
    cli.run(main)
