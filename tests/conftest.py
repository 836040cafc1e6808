"""Shared by all tests: type checks at run time, a compilation cache, and the few compiled functions that cost time."""

import collections
import functools
import gc
import getpass
import os
import pathlib
import signal
import sys
import tempfile
from importlib import metadata

import jaxtyping
import pytest

pytest.register_assert_rewrite("model_checks")  # a helper's assertions show their values, as a test's do

# Annotations are checked whenever a function of the package is called or traced; the hook has to precede the import. Left out:
# ``types``, ``learn.ppo`` and some of ``control``, whose pytrees are annotated for one environment, while ``jax.vmap`` also makes
# them with a batch axis; and ``sim.physics.warp.mujoco_warp``, of whose functions Warp reads the annotations.
_CHECKED = (
    "config",
    "math",
    "mdp",
    "sim.robot",
    "sim.robot_file",
    "sim.scene",
    "sim.linkage",
    "sim.kinematics",
    "sim.physics.mjx",
    "sim.physics.native",
    "control.controller",
    "control.gripper",
    "control.ik",
    "envs",
    "tasks",
    "urdf",
    "learn.checkpoint",
    "learn.policy",
    "learn.play.rollout",
)
# What a shell puts in the background ignores Ctrl-C, under nohup hangups, and so would the programs that tests start and signal.
for _number, _handler in ((signal.SIGINT, signal.default_int_handler), (signal.SIGHUP, signal.SIG_DFL)):
    if signal.getsignal(_number) == signal.SIG_IGN:
        signal.signal(_number, _handler)
# Most of the tests' time is XLA's. Set for the processes that tests start, too: what one has compiled, none compiles again, and
# nothing gets into the cache of whoever runs the tests.
os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "true")
if tuple(map(int, metadata.version("jaxlib").split(".")[:2])) < (0, 11):
    # Learners compile in a fifth of the time. Said as 0, and not as false, it is the user's choice (``physics.fusion``).
    os.environ.setdefault("XLA_FLAGS", "--xla_cpu_use_fusion_emitters=0")
_CACHE = pathlib.Path(tempfile.gettempdir()) / f"mjx-nero-tests-{getpass.getuser()}"
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(_CACHE))
_hook = jaxtyping.install_import_hook([f"mjx_nero.{name}" for name in _CHECKED], "beartype.beartype")
import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
from batches import Batch  # noqa: E402

import mjx_nero  # noqa: E402  (sets XLA_FLAGS, before JAX starts its backend)
from mjx_nero import __main__, control  # noqa: E402
from mjx_nero.learn import learner  # noqa: E402
from mjx_nero.learn.ppo import imitation  # noqa: E402
from mjx_nero.runs import programs  # noqa: E402
from mjx_nero.sim import physics, render  # noqa: E402
from mjx_nero.sim.physics.mjx import JaxPhysics  # noqa: E402
from mjx_nero.tasks import registry  # noqa: E402
from mjx_nero.tools import cli  # noqa: E402

jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)  # as programs do (cli.setup_jax)
jax.config.update("jax_default_matmul_precision", "highest")
# Tracing makes and drops millions of objects; looking through those that stay would take a sixteenth of the tests' time.
gc.set_threshold(50_000, 10, 10)

# Minutes of a core, of all above half of one; other files are sorted by how many of their tests are slow.
LONGEST = {"test_notebooks": 2.5, "test_shipped": 1.8, "test_controllers": 1.5, "test_physics": 1.3, "test_ppo": 1.2}
LONGEST |= {"test_strangers": 1.2, "test_machines": 0.8, "test_fuzz": 0.8, "test_programs": 0.8, "test_docs": 0.7}
LONGEST |= {"test_fuzz_models": 0.7, "test_clutter": 0.7, "test_putting": 0.7, "test_benchmark": 0.6, "test_self_test": 0.6}
LONGEST |= {"test_fixture_tasks": 0.6, "test_fitted": 0.6, "test_handover": 0.6, "test_several": 0.5, "test_distill": 0.5}


def pytest_collection_modifyitems(items):
    """The longest files come first, so that no worker is left with one at the end. GPU tests skip themselves."""
    slow = collections.Counter(item.path for item in items if item.get_closest_marker("slow"))
    items.sort(key=lambda item: (LONGEST.get(item.path.stem, 0), slow[item.path]), reverse=True)
    if any(item.get_closest_marker("gpu") for item in items) and jax.default_backend() != "gpu":
        for item in items:
            if item.get_closest_marker("gpu"):
                item.add_marker(pytest.mark.skip(reason="needs an NVIDIA GPU"))


@pytest.fixture(scope="session", autouse=True)
def programs_are_traced():
    """Tests change code while they run, which no file tells: no program is kept but where a test asks for it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(programs, "_settings", lambda: programs_are_traced)  # code from outside
        yield


@pytest.fixture(scope="module", autouse=True)
def guests_leave():
    """What a module's tests register is gone when they end: other tests list what the package itself has."""
    tables = (registry.ROBOTS, registry.ENVS, control.CONTROLLERS, physics.BACKENDS, learner.KINDS)
    before = [dict(table) for table in tables]
    yield
    for table, own in zip(tables, before, strict=True):
        table.clear()
        table.update(own)
    for name in [name for name in sys.modules if name.startswith("mjx_nero_guest_")]:
        del sys.modules[name]  # so that whoever loads the file again registers again


@pytest.fixture(scope="session")
def env() -> mjx_nero.ManipulationEnv:
    """One environment of the default preset, in MuJoCo's C library, which compiles in seconds."""
    return mjx_nero.make("nero_lift", impl="native")


@pytest.fixture(scope="session")
def batch(env) -> Batch:
    return Batch(env)


@pytest.fixture(scope="session")
def mjx_step(env):
    """The physics of ``env`` on MJX-JAX, a batch at once: (sim, ctrl) -> sim. It takes half a minute to compile."""
    step = JaxPhysics(env.physics_model, env.cfg.sim).step
    return jax.jit(jax.vmap(lambda sim, ctrl: step(sim, ctrl)[0]))


class Finish:
    """The second half of a step on one environment, jitted: the MDP on a physics state of the test's own making."""

    def __init__(self, env: mjx_nero.ManipulationEnv):
        self.env = env
        self.reset = jax.jit(env.reset)
        self._finish = jax.jit(env.finish)

    def __call__(self, state, action=None, sim=None):
        action = jnp.zeros(self.env.action_size) if action is None else jnp.asarray(action, jnp.float32)
        return self._finish(state, action, state.pipeline_state if sim is None else sim, jnp.zeros(()))


@pytest.fixture(scope="session")
def finish(env) -> Finish:
    return Finish(env)


PROGRAMS = ("train", "eval", "benchmark")
MAINS = {"mjx_nero": __main__.main}
MAINS |= {name: functools.partial(lambda name, argv: __main__.main([name, *argv]), name) for name in PROGRAMS}


@pytest.fixture
def call(monkeypatch, capfd, tmp_path):
    """``call("eval", "--env", ...) -> (exit status, stdout, stderr)``, in an empty working folder, settings of JAX left alone.

    A training clones its expert in a few steps: the 2,000 of a program take half a minute of a core.
    """
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(cli, "setup_jax", lambda: None)
    monkeypatch.setattr(imitation, "PASSES", 1.25)
    monkeypatch.setattr(cli.os, "_exit", sys.exit)  # the end of an interrupted program, not of the tests
    monkeypatch.setenv("COLUMNS", "200")

    def run(program, *argv):
        monkeypatch.setattr(sys, "argv", [f"{program}.py" if program in PROGRAMS else program, *map(str, argv)])
        capfd.readouterr()
        with pytest.raises(SystemExit) as stop:
            cli.run(MAINS[program])
        return stop.value.code, *capfd.readouterr()

    return run


@pytest.fixture
def without_opengl(monkeypatch):
    """A machine that cannot draw offscreen."""

    class Missing:
        def __init__(self, *_):
            raise ImportError("no GL")

    monkeypatch.setattr(render, "_lost", False)
    monkeypatch.setattr("mujoco.Renderer", Missing)
