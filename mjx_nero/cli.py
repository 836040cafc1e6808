"""Command-line plumbing shared by train.py, eval.py and the benchmark."""

import argparse
import logging
import os
import pathlib
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NoReturn

from rich.console import Console

from mjx_nero import config
from mjx_nero.types import UserError


class Parser(argparse.ArgumentParser):
    """Argparse whose mistakes are one line."""

    def __init__(self, **kwargs: Any):
        super().__init__(allow_abbrev=False, formatter_class=argparse.RawDescriptionHelpFormatter, **kwargs)

    def error(self, message: str) -> NoReturn:
        raise UserError(f"{message} (see --help)")

    def parse(self, argv: Sequence[str], prefixes: Sequence[str] = ()) -> tuple[argparse.Namespace, dict[str, dict[str, str]]]:
        """Flags, and for each prefix the dotted ones: ``--env.sim.dt 0.005`` -> ``{"env": {"sim.dt": "0.005"}}``."""
        args, rest = self.parse_known_args(argv)
        dotted: dict[str, dict[str, str]] = {prefix: {} for prefix in prefixes}
        while rest:
            flag, _, value = rest.pop(0).partition("=")
            prefix, _, name = flag.removeprefix("--").partition(".")
            if not flag.startswith("--") or prefix not in dotted or not name:
                self.error(f"unknown argument {flag!r}")
            if not value:
                if not rest:
                    self.error(f"{flag} needs a value")
                value = rest.pop(0)
            dotted[prefix][name] = value
        return args, dotted


def fields_help(cfgs: Mapping[str, Any]) -> str:
    """The dotted flags of the configs, for the end of a help text."""
    lines = ["any config field, with its default:"]
    for prefix, cfg in cfgs.items():
        lines += [f"  --{prefix}.{name} {value!r}" for name, value in config.flatten(cfg).items()]
    return "\n".join(lines)


def run(main: Callable[[Sequence[str]], None]) -> NoReturn:
    """Runs a program: mistakes of the user end in one line on stderr and exit status 2, Ctrl-C in 130."""
    try:
        main(sys.argv[1:])
        code = 0
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        code = 2
    except BrokenPipeError:  # the reader of our output has gone, as in `... | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 1
    except BaseException as error:
        if not interrupted(error):
            raise
        print("interrupted", file=sys.stderr, flush=True)
        sys.stdout.flush()
        os._exit(130)  # threads may be compiling still, and JAX before 0.11 crashes at the end of an interrupted compilation
    sys.exit(code)


def interrupted(error: BaseException) -> bool:
    """True of Ctrl-C, also while JAX calls native physics back: it then raises an error of its own that tells of ours."""
    return isinstance(error, KeyboardInterrupt) or "CpuCallback error" in str(error) and "KeyboardInterrupt" in str(error)


def console(highlight: bool = True) -> Console:
    """For tables: as wide as the terminal, and wide enough for names where there is none."""
    console = Console(highlight=highlight)
    if not console.is_terminal and "COLUMNS" not in os.environ:
        console.width = 160  # a pipe has no width of its own, and rich would take 80
    return console


def setup_jax() -> None:
    """Settings for programs: full float32 products, and compiled code kept in the user's cache folder between runs."""
    import jax

    jax.config.update("jax_default_matmul_precision", "highest")  # TF32 in the physics or the learner costs success
    cache = pathlib.Path(os.environ.get("XDG_CACHE_HOME") or pathlib.Path.home() / ".cache") / "mjx_nero"
    if not os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        jax.config.update("jax_compilation_cache_dir", str(cache / "jax"))
    os.environ.setdefault("WARP_CACHE_PATH", str(cache / "warp"))  # Warp reads it at its first use
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)  # a run has dozens of small programs
    logging.getLogger("jax._src.callback").setLevel(logging.CRITICAL)  # what it logs it raises as well: Ctrl-C, say


def positive(text: str) -> int:
    """Argparse type: a whole number above 0; 1e6 and 1_000_000 are fine."""
    try:
        value = float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected a whole number, got {text!r}") from None
    if value < 1 or value != int(value):
        raise argparse.ArgumentTypeError(f"expected a whole number of at least 1, got {text!r}")
    return int(value)
