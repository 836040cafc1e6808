"""Command-line code that all commands share. It imports JAX and rich only when they are needed."""

import argparse
import contextlib
import dataclasses
import gc
import importlib
import importlib.util
import logging
import os
import pathlib
import re
import sys
import traceback
import typing
import warnings
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from importlib import metadata
from typing import Annotated, Any, NoReturn

from mjx_nero import config
from mjx_nero.config import bounds, docs, values
from mjx_nero.errors import UserError, missing
from mjx_nero.runs import signals

LONGEST_NAME = 255  # bytes of a file name; the limit of all common file systems


class _Help(argparse.RawDescriptionHelpFormatter):
    """Ends the help of a flag with its default, unless the flag is a switch or its help names a default itself."""

    def _get_help_string(self, action: argparse.Action) -> str:
        said, default = action.help or "", action.default
        silent = isinstance(default, bool | list) or default in (None, "", argparse.SUPPRESS) or "(default: " in said
        return said if silent else f"{said} (default: %(default)s)"


class Parser(argparse.ArgumentParser):
    """An argument parser that reports mistakes in one line.

    Args:
        command: name of the command.
        says: what the command does; the help begins with it.
        ends: text at the end of the help.
    """

    def __init__(self, command: str, says: str = "", ends: str | None = None):
        super().__init__(called_as(command), description=says, epilog=ends, allow_abbrev=False, formatter_class=_Help)

    def add_environment(self) -> None:
        """Adds ``--load``, ``--env``, ``--preset``, ``--robot`` and ``--object``, which choose an environment."""
        self.add_load()
        self.add_argument("--env", default="nero_lift", help="environment; list-envs lists them all")
        self.add_argument("--preset", default="default", help="preset of the environment")
        self.add_argument("--robot", help="name of another robot, or folder of an imported one (default: the environment's own)")
        text = "object to lift, push or place instead of the task's own: a mesh (.obj, .stl, .glb), a folder or a name"
        self.add_argument("--object", metavar="FILE", help=f"{text} (see inspect --object; scale it by --env.object.scale)")

    def add_load(self) -> None:
        """Adds ``--load``: outside code, which runs before the names in other flags are looked up."""
        self.add_argument(
            "--load",
            action="append",
            default=[],
            metavar="FILE_OR_MODULE",
            help="Python code that registers its own environments, robots, ... (mjx_nero.register); repeatable",
        )

    def add_impl(self) -> None:
        """Adds ``--impl``: the physics implementation."""
        text = "physics: warp or jax (both MJX), or native (MuJoCo's C library) (default: the fastest on this machine)"
        self.add_argument("--impl", default="auto", help=text)

    def add_address(self) -> None:
        """Adds ``--host`` and ``--port`` of a web page."""
        self.add_argument("--host", default="127.0.0.1", help="address to listen on")
        self.add_argument("--port", type=at_most(65535), default=8080, help="port to listen on")

    def add_seed(self, default: int, several: bool = False) -> None:
        """Adds ``--seed`` and, if ``several``, ``--seeds``."""
        group = self.add_mutually_exclusive_group()
        group.add_argument("--seed", type=seed, default=default, help="random seed")
        if several:
            text = "several seeds, such as 0-7 or 0,3,5: one run for each, and a table"
            group.add_argument("--seeds", type=seeds, help=text)

    def add_fields(self, cls: type) -> None:
        """Adds a flag for each field made by ``config.flag``, with the field's name, type, bounds and description.

        A flag that the parser already has stays as it is.
        """
        about, kinds = docs.fields(cls), values.hints(cls)
        for field in dataclasses.fields(cls):
            name = f"--{field.name.replace('_', '-')}"
            if not field.metadata.get("flag") or name in self._option_string_actions:
                continue
            text = about.get(field.name, "").replace("%", "%%")
            if isinstance(field.default, bool):
                self.add_argument(name, action="store_true", default=field.default, help=text)
            else:
                self.add_argument(name, default=field.default, help=text, **_reader(kinds[field.name]))

    def add_video(self) -> None:
        """Adds the flags of videos. Their defaults give the best video that the machine draws within half a minute."""
        self.add_argument(
            "--video-size", type=size, help="size in pixels, such as 1280x720 (default: depends on the machine's speed)"
        )
        text = "frames per second (default: 25, or fewer on a slow machine)"
        self.add_argument("--video-fps", type=positive_float, default=0.0, help=text)
        text = "number of robots side by side in one picture (default: 1)"
        self.add_argument("--video-envs", type=at_most(256), default=1, help=text)

    def error(self, message: str) -> NoReturn:
        message = re.sub(r"^argument ([^\s:]+): (?=takes|must)", r"\1 ", message)  # our messages continue from the flag's name
        message = re.sub(r"^argument [^\s:]+: (?=cannot write)", "", message)
        raise UserError(f"{message} (see --help)")

    def parse(
        self,
        argv: Sequence[str],
        prefixes: Sequence[str] | Callable[[], Sequence[str]] = (),
        fields: Callable[[argparse.Namespace], str] | None = None,
    ) -> tuple[argparse.Namespace, dict[str, dict[str, str]]]:
        """Parses flags, and dotted flags by prefix: ``--env.sim.dt 0.005`` -> ``{"env": {"sim.dt": "0.005"}}``.

        Args:
            prefixes: names, or a function that returns them. It is called after outside code is loaded, which may add some.
            fields: returns the end of the help for the other flags, such as ``tools.config_help.of_environment``.
        """
        if fields and {"-h", "--help"} & set(argv):
            others, _ = self.parse([word for word in argv if word not in ("-h", "--help")], prefixes)
            self.epilog = fields(others)
        self._refuse_empty(argv)
        args, rest = self.parse_known_args(argv)
        if hasattr(args, "load"):
            load_guests(args.load)
        dotted: dict[str, dict[str, str]] = {prefix: {} for prefix in (prefixes() if callable(prefixes) else prefixes)}
        while rest:
            flag, equals, value = rest.pop(0).partition("=")
            prefix, _, name = flag.removeprefix("--").partition(".")
            if not flag.startswith("--") or prefix not in dotted or not name:
                self.error(f"unknown argument {values.short(flag)}{values.hint(flag, self._option_string_actions)}")
            if not equals:
                if not rest:
                    self.error(f"{values.short(flag)[1:-1]} needs a value")
                value = rest.pop(0)
            dotted[prefix][name] = value
        if "env" in dotted and getattr(args, "object", None) is not None:
            dotted["env"].setdefault("object.file", args.object)
        return args, dotted

    def only(self, dotted: Mapping[str, Mapping[str, str]], learners: Sequence[str], learner: str) -> None:
        """Refuses the fields of learners other than the chosen one."""
        for name in learners:
            if dotted[name] and name != learner:
                self.error(f"--{name}.* is for --learner {name}, and this is {learner}")

    def _refuse_empty(self, argv: Sequence[str]) -> None:
        """Refuses ``--robot ""``, as a shell makes of ``--robot "$ROBOT"``: an unset variable must not mean the default.

        Only a config's field may be empty (``--env.scene.objects.cube.file ""``).
        """
        for before, word in zip(("", *argv), argv, strict=False):
            flag, equals, value = word.partition("=")
            field = before.startswith("--") and "." in before
            if not word and not field or equals and not value and flag in self._option_string_actions:
                taker = self._option_string_actions.get(before)
                self.error(f"{flag or (before if taker and taker.nargs != 0 else 'an argument')} got an empty value")

    def given(self, argv: Sequence[str]) -> set[str]:
        """Returns the names of the flags in ``argv``, as ``parse`` names them, without the dotted ones."""
        nothing = object()
        absent = {action.dest: None if isinstance(action.default, list) else nothing for action in self._actions}  # lists grow
        found, _ = self.parse_known_args(argv, argparse.Namespace(**absent))
        return {name for name, value in absent.items() if getattr(found, name, value) is not value}


def load_guests(names: Sequence[str] = ()) -> None:
    """Runs outside code once each: the entry points ``mjx_nero`` of installed packages, and the named files or modules.

    Raises:
        UserError: a file or module does not exist, or fails.
    """
    for entry in metadata.entry_points(group="mjx_nero"):
        with _blamed(f"{entry.name} ({entry.value})"):
            entry.load()
    for name in names:
        with _blamed(name):
            if not name.endswith(".py"):
                if os.getcwd() not in sys.path:  # a module in the current folder, as for python -m
                    sys.path.insert(0, os.getcwd())
                if getattr(importlib.import_module(name), "__file__", "") is None:
                    raise UserError("it is a folder without an __init__.py: name a module, or a file that ends in .py")
            elif (module := f"mjx_nero_guest_{pathlib.Path(name).resolve()}") not in sys.modules:
                spec = importlib.util.spec_from_file_location(module, name)
                assert spec and spec.loader
                from mjx_nero import files  # needs installed packages

                with files.open_file(pathlib.Path(name)):
                    pass  # the message is plainer than the loader's
                sys.modules[module] = importlib.util.module_from_spec(spec)
                spec.loader.exec_module(sys.modules[module])


@contextlib.contextmanager
def _blamed(name: str) -> Iterator[None]:
    """Turns an error in outside code into one line that says where it happened."""
    try:
        yield
    except Exception as error:
        frames = traceback.extract_tb(error.__traceback__)
        theirs = [f"{at.filename}:{at.lineno}" for at in frames if at.filename != __file__ and "importlib" not in at.filename]
        where = f" ({theirs[-1]})" if theirs and not isinstance(error, UserError | FileNotFoundError) else ""
        kind = "" if isinstance(error, UserError) else f"{type(error).__name__}: "
        raise UserError(f"cannot load {name}: {kind}{' '.join(str(error).split())}{where}") from error


def listed(title: str, meanings: Mapping[str, str]) -> str:
    """Lists names and their meanings, one per line, for a help text."""
    width = max(map(len, meanings))
    return "\n".join([f"{title}:", *(f"  {name:<{width}}  {meaning}" for name, meaning in meanings.items())])


def run(main: Callable[[Sequence[str]], None]) -> NoReturn:
    """Runs a program.

    A user's mistake ends in one line on stderr and exit status 2. Ctrl-C and the other ``signals.SIGNALS`` let the program clean
    up, and end it with status 128 plus the signal's number.
    """
    _occupy_streams()
    try:
        with signals.at_once(), warnings.catch_warnings():
            from mjx_nero.files import cache  # needs installed packages

            cache.check_addresses()
            try:
                warnings.showwarning = _warn
                main(sys.argv[1:])
            finally:
                _flush()  # what is still unwritten may fail like everything before
        code = 0
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        code = 2
    except ModuleNotFoundError as error:
        if (error.name or "").startswith("mjx_nero"):
            raise
        print(f"error: {missing(error)}", file=sys.stderr)
        code = 2
    except BrokenPipeError:  # the reader of our output is gone, as in `... | head`
        code = 1
    except OSError as error:  # from a path that the user gave: a name too long, no permission, a full disk
        print(f"error: {UserError(str(error))}", file=sys.stderr)
        code = 2
    except KeyboardInterrupt as error:
        print("interrupted", file=sys.stderr, flush=True)
        # Threads may still be compiling, and JAX before 0.11 crashes at the end of an interrupted compilation.
        os._exit(getattr(error, "code", 130))
    try:
        _flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # or else Python complains of unwritten output as it ends
    sys.exit(code)


def _warn(message: Warning | str, *_: Any, **__: Any) -> None:
    """Prints a warning in one line, without the place in the code that gave it."""
    print(f"warning: {' '.join(str(message).split())}", file=sys.stderr)


def _flush() -> None:
    if sys.stdout:  # None: the caller has closed it
        sys.stdout.flush()


def _occupy_streams() -> None:
    """Opens the standard streams that the caller has closed. A file would get their numbers, and the messages of C libraries."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free number


def tune_python() -> None:
    """Lets Python look for garbage less often, because imports and traces make hundreds of thousands of objects, which last; and
    lets its threads take turns more often, because one that compiles, reads files or steps MuJoCo asks for many short ones.
    """
    gc.set_threshold(100_000)
    sys.setswitchinterval(0.0005)


def setup_jax() -> None:
    """Configures JAX for programs: full float32 products, compiled code kept in the user's cache folder, and no more of a GPU's
    memory than they use. To reserve three quarters of it takes a second of every start, and other programs find none left.
    """
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    import jax

    jax.config.update("jax_default_matmul_precision", "highest")  # TF32 in physics or learner lowers the success rate
    from mjx_nero.files import cache

    kept = cache.folder()
    if kept:
        if not os.environ.get("JAX_COMPILATION_CACHE_DIR"):
            jax.config.update("jax_compilation_cache_dir", str(kept / "jax"))
            cache.heal(kept / "jax")
        os.environ.setdefault("WARP_CACHE_PATH", str(kept / "warp"))  # Warp reads it at its first use
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)  # a run has dozens of small programs
    logging.getLogger("jax._src.callback").setLevel(logging.CRITICAL)  # it also raises what it logs, such as Ctrl-C


def called_as(command: str) -> str:
    """Returns the start of a command line to show, for the program that the user called."""
    name = pathlib.Path(sys.argv[0]).name
    if name == f"{command}.py":
        return f"python {name}"
    return f"mjx-nero {command}" if name == "mjx-nero" else f"python -m mjx_nero {command}"


def number(kind: Any) -> Callable[[str], Any]:
    """Makes an argparse type: any value that ``values.read`` accepts for the annotation ``kind``, within its ``bounds``."""

    def read(text: str) -> Any:
        try:
            return values.read(kind, text, "")
        except UserError as error:
            raise argparse.ArgumentTypeError(str(error).strip()) from None

    return read


def fields(args: argparse.Namespace, cls: type) -> dict[str, Any]:
    """Returns the values of the flags that ``Parser.add_fields`` made, by field name."""
    return {name: getattr(args, name) for name in config.marked(cls)}


def _reader(kind: Any) -> dict[str, Any]:
    """Returns argparse's arguments for a field's declared type."""
    kind = next((each for each in typing.get_args(kind) if each is not type(None)), kind) if _optional(kind) else kind
    if kind is pathlib.Path:
        return {"type": path()}
    for bound in getattr(kind, "__metadata__", ()):
        if isinstance(bound, bounds.OneOf):
            return {"choices": [name for name in bound.names if name]}
    return {"type": number(kind)}


def _optional(kind: Any) -> bool:
    return type(None) in typing.get_args(kind)


positive = number(bounds.Count)  # a whole number from 1; 1e6 is allowed, 1_000 is not
positive_float = number(bounds.Positive)
non_negative = number(bounds.NonNegative)
share = number(Annotated[float, bounds.Bounds(0.0, 1.0, above=True)])
seed = number(bounds.Seed)


def choices(text: str, what: str, valid: Collection[str]) -> list[str]:
    """Reads a comma-separated list of names and drops repeated ones.

    Raises:
        UserError: a name is not valid, or the list is empty.
    """
    chosen = list(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))
    unknown = [name for name in chosen if name not in valid]
    if unknown or not chosen:
        raise UserError(f"unknown {what} {', '.join(unknown) or '(none)'}: choose from {', '.join(valid)}")
    return chosen


def seeds(text: str) -> tuple[int, ...]:
    """Argparse type: seeds and ranges of seeds, such as ``0-7`` or ``0,3,5``."""
    found: list[int] = []
    for part in text.split(","):
        first, dash, last = part.partition("-")
        if not (first.isdecimal() and (last.isdecimal() or not dash)) or int(last or first) - int(first) not in range(1000):
            raise argparse.ArgumentTypeError(f"takes seeds as in 0-7 or 0,3,5, got {values.short(text)}")
        found += range(seed(first), seed(last or first) + 1)
    if len(set(found)) < len(found):
        raise argparse.ArgumentTypeError(f"takes each seed once, got {values.short(text)}")
    return tuple(found)


def at_most(most: int) -> Callable[[str], int]:
    """Makes an argparse type: a whole number from 1 to ``most``."""
    return number(Annotated[int, bounds.Bounds(1, most)])


def path(*suffixes: str) -> Callable[[str], pathlib.Path]:
    """Makes an argparse type: a path that a file system accepts, with one of the suffixes (``.mp4``) if any are given."""

    def read(text: str) -> pathlib.Path:
        found = pathlib.Path(text)
        if (
            not text
            or "\0" in text
            or len(os.fsencode(text)) > 4096
            or any(len(os.fsencode(p)) > LONGEST_NAME for p in found.parts)
        ):
            raise argparse.ArgumentTypeError(f"takes a path with names of at most {LONGEST_NAME} bytes, got {values.short(text)}")
        if suffixes and found.suffix.lower() not in suffixes:
            raise argparse.ArgumentTypeError(f"takes a name that ends in {' or '.join(suffixes)}, got {values.short(text)}")
        return found

    return read


def output(*suffixes: str, marks: Sequence[str] = ()) -> Callable[[str], pathlib.Path]:
    """Makes an argparse type: the path of a file that the command will write, which is tried at once, before long work.

    Args:
        marks: see ``files.check_writable``.
    """

    def read(text: str) -> pathlib.Path:
        found = path(*suffixes)(text)
        from mjx_nero import files  # needs installed packages

        try:
            files.check_writable(found, marks)
        except UserError as error:
            raise argparse.ArgumentTypeError(str(error)) from None
        return found

    return read


def size(text: str) -> tuple[int, int]:
    """Argparse type: width and height in pixels, even numbers because encoders need them."""
    found = re.fullmatch(r"(\d{2,4})x(\d{2,4})", text)
    if not found or any(int(n) % 2 for n in found.groups()):
        raise argparse.ArgumentTypeError(f"takes even numbers of pixels as in 1280x720, got {values.short(text)}")
    return int(found[1]), int(found[2])
