"""All commands: python -m mjx_nero COMMAND ..., or mjx-nero COMMAND ... (each has its --help)."""

import importlib
import signal
from collections.abc import Sequence
from typing import NoReturn

# command -> (module, function of the arguments, what it does)
COMMANDS = {
    "train": ("mjx_nero.tools.train", "main", "train a policy"),
    "eval": ("mjx_nero.tools.eval", "main", "play and measure a policy or a controller"),
    "view": ("mjx_nero.tools.view.command", "main", "show environments in a browser: watch them and take part"),
    "demos": ("mjx_nero.tools.demos", "main", "write a data set of demonstrations, for LeRobot or as arrays"),
    "export": ("mjx_nero.tools.export", "main", "write a policy as ONNX, with everything a runtime needs"),
    "deploy": ("mjx_nero.tools.deploy", "main", "run an exported policy on a real, emulated or simulated arm"),
    "robustness": ("mjx_nero.tools.robustness", "main", "measure a policy's success over the range of each world parameter"),
    "benchmark": ("mjx_nero.tools.benchmark.command", "main", "measure the speed of this machine"),
    "results": ("mjx_nero.tools.results", "main", "measure how every environment learns and what the bundled policies achieve"),
    "public-robots": ("mjx_nero.tools.public_robots", "main", "import and test public robot descriptions, and write their table"),
    "list-envs": ("mjx_nero.tools.list_envs", "main", "list the environments: robot, presets, bundled policies"),
    "inspect": ("mjx_nero.tools.inspect", "main", "show a robot, a model folder or an environment: joints, gains, contacts"),
    "import-urdf": ("mjx_nero.tools.import_urdf", "main", "make a model folder from a URDF"),
    "tune-gains": ("mjx_nero.tools.tuning", "main", "propose stiffness and damping from step responses"),
    "record": ("mjx_nero.tools.identification", "record_main", "log the drives of a real or simulated arm"),
    "replay": ("mjx_nero.tools.replay", "main", "show a logged run of an arm beside the simulation's prediction"),
    "identify": (
        "mjx_nero.tools.identification",
        "identify_main",
        "fit a real arm's gains, friction, delay and offsets to a log",
    ),
}


def main(argv: Sequence[str]) -> None:
    """Passes the arguments to the command that the first of them names."""
    from mjx_nero.config import values
    from mjx_nero.errors import UserError
    from mjx_nero.tools import cli

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
    found = importlib.import_module(module)
    getattr(found, function)(argv[1:])


def program(*command: str) -> NoReturn:
    """Runs the console script ``mjx-nero``, or one of its commands as a separate program."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)  # until ``cli.run`` handles it, Ctrl-C ends the imports without a traceback
    from mjx_nero.tools import cli

    cli.tune_python()
    cli.run(lambda argv: main([*command, *argv]))


if __name__ == "__main__":
    program()
