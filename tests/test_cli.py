"""Command lines: kinds of numbers and paths, help of every field, and programs outside their environment."""

import argparse
import ast
import dataclasses
import json
import os
import pathlib
import subprocess
import sys
import tempfile
import time
from typing import Annotated

import pytest

import mjx_nero
from mjx_nero import config, control, env_cfg, list_envs, list_presets
from mjx_nero.__main__ import COMMANDS
from mjx_nero.config import bounds, docs
from mjx_nero.control.pick_up import PickUpCfg
from mjx_nero.learn import learner
from mjx_nero.learn.ppo.cfg import PpoCfg
from mjx_nero.runs import evaluation, signals, training
from mjx_nero.runs.cfg import RunCfg
from mjx_nero.tasks import registry
from mjx_nero.tools import cli, config_help, train
from mjx_nero.tools import eval as evaluate

ROOT = pathlib.Path(__file__).parents[1]


@pytest.mark.parametrize(
    ("kind", "text", "value"),
    [
        (cli.positive, "7", 7),
        (cli.positive, "1e6", 1_000_000),
        (cli.positive, "8000000000", 8_000_000_000),
        (cli.seed, "0", 0),
        (cli.seed, "4294967295", 2**32 - 1),
        (cli.positive_float, ".5", 0.5),
        (cli.non_negative, "0", 0.0),
        (cli.share, "1", 1.0),
        (cli.at_most(100), "100", 100),
    ],
)
def test_numbers_of_flags(kind, text, value):
    assert kind(text) == value and type(kind(text)) is type(value)


REFUSED = [
    (
        cli.positive,
        {
            "many": "takes a whole number, got 'many'",
            "0": "must be at least 1, got '0'",
            "2.5": "takes a whole number, got '2.5'",
            "1_000": "takes a whole number, got '1_000'",
            "inf": "takes a whole number, got 'inf'",
            "1e999": "takes a whole number, got '1e999'",
            "9" * 400: "takes a whole number, got '9{20,30}\\.\\.\\.9{20,30}'",
            "": "takes a whole number, got ''",
        },
    ),
    (
        cli.seed,
        {
            "4294967296": "must be at least 0 and at most 4294967295, got '4294967296'",
            "-1": "must be at least 0 and at most 4294967295, got '-1'",
            "18446744073709551616": "takes a whole number, got '18446744073709551616'",
        },
    ),
    (
        cli.non_negative,
        {
            "nan": "takes a finite number, got 'nan'",
            "-0.1": "must be at least 0, got '-0.1'",
        },
    ),
    (
        cli.positive_float,
        {
            "inf": "takes a finite number, got 'inf'",
            "0": "must be above 0, got '0'",
        },
    ),
    (
        cli.share,
        {
            "0": "must be above 0 and at most 1, got '0'",
        },
    ),
    (
        cli.at_most(1_000),
        {
            "1e12": "must be at least 1 and at most 1000, got '1e12'",
        },
    ),
    (
        cli.path(),
        {
            "x" * 300: "takes a path with names of at most 255 bytes, got 'x{20,30}\\.\\.\\.x{20,30}'",
            "a\0b": "takes a path with names of at most 255 bytes",
            "": "takes a path",
        },
    ),
    (
        cli.path(".mp4"),
        {
            "v.zzz": "takes a name that ends in .mp4, got 'v.zzz'",
        },
    ),
]


@pytest.mark.parametrize(("kind", "text", "message"), [(kind, *each) for kind, said in REFUSED for each in said.items()])
def test_what_flags_refuse(kind, text, message):
    with pytest.raises(argparse.ArgumentTypeError, match=message) as error:
        kind(text)
    assert "\n" not in str(error.value) and len(str(error.value)) < 200


def test_a_flag_and_its_fault_read_as_one_sentence():
    parser = cli.Parser("x")
    parser.add_argument("--seed", type=cli.seed)
    with pytest.raises(mjx_nero.UserError, match=r"^--seed takes a whole number, got '1e99' \(see --help\)$"):
        parser.parse(["--seed", "1e99"])
    with pytest.raises(mjx_nero.UserError, match=r"^--seed must be at least 0 and at most 4294967295, got '-1' \(see --help\)$"):
        parser.parse(["--seed=-1"])


@dataclasses.dataclass(frozen=True)
class Asked:
    """
    Attributes:
        minutes: how long at most; 100% of it.
    """

    minutes: bounds.NonNegative = config.flag(2.5, free=True)
    where: pathlib.Path | None = config.flag(None)
    how: Annotated[str, bounds.OneOf("", "fast", "slow")] = config.flag("")
    loudly: bool = config.flag(False)  # say more
    seed: bounds.Seed = config.flag(0)
    inner: int = 7


def test_flags_are_made_of_a_config():
    parser = cli.Parser("x")
    parser.add_seed(5)
    parser.add_fields(Asked)
    assert config.marked(Asked) == ("minutes", "where", "how", "loudly", "seed") and config.marked(Asked, "free") == ("minutes",)
    nothing = {"minutes": 2.5, "where": None, "how": "", "loudly": False, "seed": 5}  # what is there already stays
    assert cli.fields(parser.parse([])[0], Asked) == nothing
    found = cli.fields(parser.parse(["--minutes", "1e1", "--where", "a/b", "--how", "fast", "--loudly"])[0], Asked)
    assert found == {"minutes": 10.0, "where": pathlib.Path("a/b"), "how": "fast", "loudly": True, "seed": 5}
    help = " ".join(parser.format_help().split())
    assert "--minutes MINUTES how long at most; 100% of it (default: 2.5)" in help and "--loudly say more" in help
    assert "--inner" not in help


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["--minutes", "-1"], r"^--minutes must be at least 0, got '-1' \(see --help\)$"),
        (["--minutes", "nan"], "^--minutes takes a finite number, got 'nan'"),
        (["--how", "warm"], "invalid choice: 'warm'"),
        (["--where", ""], "^--where got an empty value"),
    ],
)
def test_flags_of_a_config_keep_to_its_bounds(argv, message):
    parser = cli.Parser("x")
    parser.add_fields(Asked)
    with pytest.raises(mjx_nero.UserError, match=message):
        parser.parse(argv)


def test_a_run_and_what_is_played_have_flags_for_their_fields():
    """What the programs read stands in the configs alone: every flag's default is the field's; a learner's is the task's own."""
    for cls, parser in ((RunCfg, train._parser()), (evaluation.EvalCfg, evaluate._parser())):
        args, _ = parser.parse([])
        found = {f.name: f.default for f in dataclasses.fields(cls) if f.metadata.get("flag")}
        assert cli.fields(args, cls) == found | ({"learner": None} if "learner" in found else {})


def test_an_empty_value_of_a_field_is_one():
    assert cli.Parser("x").parse(["--env.name=", "--env.a", ""], prefixes=("env",))[1] == {"env": {"name": "", "a": ""}}


@pytest.mark.parametrize("name", list_envs())
def test_help_describes_every_field(name):
    for preset in list_presets(name):
        cfg = env_cfg(name, preset, None if registry.robot_of(name) else "nero")
        for described in (cfg, training.learner_cfg(cfg, preset)):
            about = config.describe(described)
            assert list(about) == list(config.flatten(described))
            assert not [field for field, text in about.items() if not text]


def test_help_describes_every_field_of_the_controllers_and_learners():
    own = [learner.cfg_for(name, "default", {}) for name in learner.names()] + [cfg for _, cfg in control.CONTROLLERS.values()]
    for cfg in own:
        guest = not type(cfg).__module__.startswith("mjx_nero.")  # of another test
        assert guest or all(config.describe(cfg).values())


def test_help_takes_its_texts_from_where_the_fields_are():
    about = config.describe(env_cfg("nero_lift"))
    assert about["robot.arm.stiffness"] == "[N m/rad] or [N/m]"  # under Attributes
    assert about["sim.dt"] == "physics step [s]"  # behind the field
    assert about["rewards.reaching_object.weight"] == "multiplies the function, per second of simulated time"  # of a term
    assert about["actions.arm.params.time"] == "time constant with which velocities follow the action [s]"  # of a term's class
    assert about["rewards.goal_tracking.params.std"].startswith("parameter of: 1 - tanh(d / std) while held")
    lines = config_help.listed({"env": env_cfg("nero_lift")}).splitlines()
    assert lines[lines.index("  --env.sim.dt 0.01") + 1] == "        physics step [s]"
    assert lines[lines.index("  --env.controllers.pick_up.speed 0.4") + 1].strip() == docs.fields(PickUpCfg)["speed"]
    assert lines[lines.index("  --env.training.max_std 0.5") + 1].strip() == docs.fields(PpoCfg)["max_std"]


def test_a_field_without_a_text_of_its_own_has_none():
    @dataclasses.dataclass(frozen=True)
    class Inner:
        """Says nothing of its fields."""

        bare: float = 1.0

    @dataclasses.dataclass(frozen=True)
    class Outer:
        """Says something of one."""

        inner: Inner = Inner()  # what Inner is for

    assert config.describe(Outer()) == {"inner.bare": ""}


def _python(*args: str, **env: str) -> subprocess.CompletedProcess:
    return subprocess.run([sys.executable, *args], capture_output=True, text=True, env={**os.environ, **env}, cwd=ROOT)


@pytest.mark.parametrize("argv", [["train.py"], ["eval.py"], ["-m", "mjx_nero", "list-envs"]], ids=" ".join)
def test_outside_the_environment_a_program_ends_in_one_line(argv):
    found = _python("-S", *argv)  # -S: without the installed packages
    assert found.returncode == 2 and found.stdout == ""
    assert found.stderr.count("\n") == 1 and found.stderr.startswith("error: ")
    assert "does not have the package" in found.stderr and "activate the environment" in found.stderr


def test_outside_the_environment_the_package_says_what_to_do():
    found = _python("-S", "-c", "import mjx_nero; print(mjx_nero.__version__)\nfrom mjx_nero import make")
    assert found.stdout == f"{mjx_nero.__version__}\n"
    assert "activate the environment" in found.stderr.splitlines()[-1] and "ModuleNotFoundError" not in found.stderr
    with pytest.raises(AttributeError, match="no attribute 'mak'"):
        mjx_nero.mak  # noqa: B018


def test_only_tools_and_interop_import_the_face_of_the_package():
    """It names what lies above: a module that imports it would depend on all of that."""
    package = pathlib.Path(mjx_nero.__file__).parent
    importers = {path.relative_to(package) for path in package.rglob("*.py") if _imports_the_face(path)}
    assert importers and {path.parts[0] for path in importers} <= {"interop", "tools"}


def _imports_the_face(path):
    nodes = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Import | ast.ImportFrom)]
    whole = any(name.name == "mjx_nero" for node in nodes if isinstance(node, ast.Import) for name in node.names)
    return whole or any(
        name.name in (*mjx_nero.__all__, "__version__")
        for node in nodes
        if isinstance(node, ast.ImportFrom) and node.module == "mjx_nero"
        for name in node.names
    )


def test_public_names_are_there():
    assert set(mjx_nero.__all__) <= set(dir(mjx_nero))
    assert all(getattr(mjx_nero, name) is not None for name in mjx_nero.__all__)


def test_an_evaluation_in_mujocos_library_leaves_alone_what_it_does_not_need():
    """Warp and MuJoCo Warp take longer to import than all the rest together. Both can still be imported afterwards."""
    code = (
        "import atexit, sys; atexit.register(lambda: print(*sys.modules)); import mjx_nero.__main__ as all; all.program('eval')"
    )
    found = _python("-c", code, "--env", "nero_reach", "--impl", "native", "--episodes", "2", "--env.episode_length_s", "0.2")
    assert found.returncode == 0 and "success rate" in found.stdout, found.stderr
    modules = set(found.stdout.splitlines()[-1].split())
    others = {"torch", "onnx", "matplotlib", "viser", "gymnasium"}
    assert {"jax", "mujoco.mjx", "mjx_nero.sim.physics.native"} <= modules
    assert not ({"warp", "mujoco.mjx.third_party.mujoco_warp", "trimesh"} | others) & modules
    both = "from mujoco.mjx.third_party import mujoco_warp; import warp; warp.kernel, mujoco_warp.step"
    assert _python("-c", f"import mjx_nero.learn.policy; {both}").returncode == 0


HELPS = """
import contextlib, io, json, os, sys
import mjx_nero.__main__ as all
import mjx_nero.tasks.registry  # once for all commands
for command in all.COMMANDS:
    if not os.fork():
        with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):
            all.main([command, *(["--help"] if command != "list-envs" else [])])
        print(json.dumps([command, *sys.modules]), flush=True)
        os._exit(0)
    os.wait()
"""
HEAVY = {"brax", "mujoco.mjx", "warp", "torch", "onnx", "matplotlib", "viser", "gymnasium", "pandas"}
FITS = {"import-urdf", "tune-gains", "identify", "record", "replay"}  # with SciPy, which has hundreds of modules


def test_help_and_list_envs_import_little():
    """Modules are counted, as seconds are not the same on every machine. JAX and the configs are 1,050; MJX and Brax 500 more."""
    found = _python("-c", HELPS)
    modules = {command: set(names) for command, *names in map(json.loads, found.stdout.splitlines())}
    assert modules.keys() == COMMANDS.keys(), found.stderr
    assert not {command: HEAVY & names for command, names in modules.items() if HEAVY & names}
    assert not {command: len(names) for command, names in modules.items() if len(names) > 1200 and command not in FITS}
    assert "jax" not in _python("-c", "import sys, mjx_nero; print(*sys.modules)").stdout.split()


# --- ends


@pytest.mark.parametrize("number", signals.SIGNALS)
def test_a_signal_lets_every_command_clean_up(tmp_path, monkeypatch, capfd, number):
    def main(argv):
        with tempfile.TemporaryDirectory(dir=tmp_path):
            print("half of it", end="")
            os.kill(os.getpid(), number)
            time.sleep(10)

    monkeypatch.setattr(cli.os, "_exit", sys.exit)
    with pytest.raises(SystemExit) as stop:
        cli.run(main)
    assert stop.value.code == 128 + number and capfd.readouterr() == ("half of it", "interrupted\n")
    assert not list(tmp_path.iterdir())


def test_the_last_of_the_output_may_find_nobody():
    """Python holds a short output back until its end, and complains there in lines of its own."""
    read, write = os.pipe()
    os.close(read)
    full, env = os.open("/dev/full", os.O_WRONLY), {**os.environ, "PYTHONUNBUFFERED": ""}
    for stdout, code, said in ((write, 1, ""), (full, 2, "error: [Errno 28] No space left on device\n")):
        command = [sys.executable, "-m", "mjx_nero", "list-envs", "--help"]
        done = subprocess.run(command, stdout=stdout, stderr=subprocess.PIPE, text=True, env=env, cwd=ROOT)
        assert (done.returncode, done.stderr) == (code, said)


def test_files_do_not_become_a_closed_output(tmp_path):
    """A caller such as cron may close the standard streams; a file then got the number that libraries write messages to."""
    code = f"from mjx_nero.tools import cli; cli.run(lambda _: print(open({str(tmp_path / 'a')!r}, 'w').fileno()))"
    command = ["sh", "-c", 'exec "$@" 0<&- 2>&-', "sh", sys.executable, "-c", code]
    done = subprocess.run(command, stdout=subprocess.PIPE, cwd=ROOT)
    assert done.returncode == 0 and int(done.stdout) > 2
