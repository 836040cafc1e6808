"""All commands: python -m mjx_nero COMMAND ..., or mjx-nero COMMAND ... (each has its --help)."""

import gc
import importlib
from collections.abc import Sequence
from typing import NoReturn

from mjx_nero.config import values
from mjx_nero.errors import UserError
from mjx_nero.tools import cli

# command -> (module, function of the arguments, what it does)
COMMANDS = {
    "train": ("mjx_nero.tools.train", "main", "train a policy"),
    "eval": ("mjx_nero.tools.eval", "main", "play and measure a policy or a controller"),
    "view": ("mjx_nero.tools.view.command", "main", "environments in a browser: watch them and take part"),
    "demos": ("mjx_nero.tools.demos", "main", "a data set of demonstrations, for LeRobot or as arrays"),
    "export": ("mjx_nero.tools.export", "main", "a policy as ONNX, with all that a runtime has to know"),
    "deploy": ("mjx_nero.tools.deploy", "main", "an exported policy on an arm, real, emulated or simulated"),
    "robustness": ("mjx_nero.tools.robustness", "main", "a policy's success over the range of each parameter of the world"),
    "benchmark": ("mjx_nero.tools.benchmark.command", "main", "what this machine does in a second"),
    "results": ("mjx_nero.tools.results", "main", "how every environment learns, and what the bundled policies achieve"),
    "public-robots": ("mjx_nero.tools.public_robots", "main", "public descriptions imported and tried: their table"),
    "list-envs": ("mjx_nero.tools.list_envs", "main", "the environments: task, robot, presets"),
    "inspect": ("mjx_nero.tools.inspect", "main", "a robot, a model folder or an environment: joints, gains, contacts"),
    "import-urdf": ("mjx_nero.tools.import_urdf", "main", "a model folder from a URDF"),
    "tune-gains": ("mjx_nero.tools.tuning", "main", "stiffness and damping from step responses"),
    "record": ("mjx_nero.tools.identification", "record_main", "a log of an arm's drives, real or simulated"),
    "replay": ("mjx_nero.tools.replay", "main", "a logged run of an arm, beside the simulation's prediction"),
    "identify": ("mjx_nero.tools.identification", "identify_main", "a real arm's gains, friction, delay and offsets, from a log"),
}


def main(argv: Sequence[str]) -> None:
    """Hands the arguments to a command."""
    if not argv or argv[0] in ("-h", "--help"):
        commands = cli.listed("commands", {name: what for name, (_, _, what) in COMMANDS.items()})
        print(f"usage: python -m mjx_nero COMMAND ...\n\n{commands}")
        if not argv:
            raise UserError(f"name a command: {', '.join(COMMANDS)}")
        return
    if argv[0] not in COMMANDS:
        near = values.hint(argv[0], COMMANDS)
        raise UserError(f"unknown command {values.short(argv[0])}{near}: choose one of {', '.join(COMMANDS)}")
    module, function, _ = COMMANDS[argv[0]]
    gc.disable()  # imports make hundreds of thousands of objects that stay: to look through them takes a tenth of the time
    try:
        found = importlib.import_module(module)
    finally:
        gc.enable()
    getattr(found, function)(argv[1:])


def program(*command: str) -> NoReturn:
    """The console script ``mjx-nero``, or one of its commands as a program of its own."""
    cli.run(lambda argv: main([*command, *argv]))


if __name__ == "__main__":
    program()
