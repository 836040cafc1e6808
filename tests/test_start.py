"""What a start costs: the packages that commands import, the programs that they compile, and what waits for what."""

import concurrent.futures
import dataclasses
import json
import os
import pathlib
import subprocess
import sys
import threading
import time
import types

import jax
import numpy as np
import pytest

from mjx_nero.envs import env
from mjx_nero.errors import UserError
from mjx_nero.learn import checkpoint, machines
from mjx_nero.learn.learner import state_shape
from mjx_nero.learn.play import rollout
from mjx_nero.runs import cfg, compiled, starts
from mjx_nero.runs.programs import Programs
from mjx_nero.sim import physics
from mjx_nero.tasks import registry

ROOT = pathlib.Path(__file__).parents[1]
# Runs a command, and prints which packages and modules it has imported and the names of the programs that it has compiled.
WATCHED = """
import atexit, json, sys
programs = []
if "jax" in sys.argv[1]:
    import jax
    def note(event, seconds, fun_name="", **_):
        if event.endswith("backend_compile_duration"):
            programs.append(fun_name)
    jax.monitoring.register_event_duration_secs_listener(note)
atexit.register(lambda: print(json.dumps([list(sys.modules), programs])))
del sys.argv[1]
from mjx_nero.__main__ import program
program()
"""
# Their import takes longer than that of MuJoCo, and what starts here does without.
SELDOM = {"scipy.spatial", "scipy.optimize", "scipy.stats", "trimesh", "warp", "jaxopt"}
SELDOM |= {"brax.generalized.pipeline", "brax.envs.ant"}


def _watched(*argv: str, jax: str = "") -> tuple[set[str], list[str]]:
    done = subprocess.run([sys.executable, "-c", WATCHED, jax, *argv], stdout=subprocess.PIPE, text=True, cwd=ROOT, check=True)
    modules, programs = json.loads(done.stdout.splitlines()[-1])
    return set(modules), programs


@pytest.fixture
def programs():
    """The names of the programs that are compiled from here on."""
    names: list[str] = []

    def note(event, seconds, fun_name="", **_):
        if event.endswith("backend_compile_duration"):
            names.append(fun_name)

    jax.monitoring.register_event_duration_secs_listener(note)
    yield names
    jax.monitoring.unregister_event_duration_listener(note)


def test_an_evaluation_compiles_few_programs_and_imports_no_other_engine():
    argv = ("eval", "--env", "nero_reach", "--episodes", "3", "--env.episode_length_s", "0.1")
    modules, programs = _watched(*argv, jax="jax")
    assert programs.count("jit(run)") == 1 and len(programs) <= 4, programs  # 23 once
    assert not modules & SELDOM


@pytest.mark.parametrize(("command", "absent"), [("--help", {"jax", "mujoco", "numpy"}), ("list-envs", {"brax", "mujoco.mjx"})])
def test_commands_that_compute_nothing_import_little(command, absent):
    modules, programs = _watched(command)
    assert "mjx_nero.__main__" in modules and not modules & absent and not programs


def test_what_a_training_imports_before_it_begins():
    code = "import json, sys, mjx_nero.tools.train_run, mjx_nero.learn.ppo.learner; print(json.dumps(list(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, cwd=ROOT, check=True)
    found = set(json.loads(done.stdout))
    assert "mjx_nero.runs.training" in found and not found & SELDOM


def test_one_thread_traces_what_training_waits_for_and_the_evaluation_is_made_beside_it(monkeypatch):
    """A first state waits for the expert, whose program takes seconds to trace and minutes to compile."""
    run = cfg.resolve("nero_reach", "default", None, {"episode_length_s": 0.2}, {"num_envs": 8}, impl="native")
    run = dataclasses.replace(run, eval_episodes=2)
    learner, begun, order = compiled.make_learner(run), threading.Event(), []
    lower = Programs.lower

    def lowered(self, name, *rest, **options):
        order.append((name.partition("-")[0], threading.current_thread()))
        if name.startswith("evaluation"):
            assert begun.wait(120)
        return lower(self, name, *rest, **options)

    programs = Programs(run, learner)
    fresh = compiled.Fresh(learner, None, programs)
    monkeypatch.setattr(Programs, "lower", lowered)
    made = compiled.compile(run, learner, 1, lambda: fresh.placed(0), programs, lambda beside: fresh.trace(0, beside))
    state, _ = made.advance(made.state)  # training has begun, and no evaluation has been traced
    begun.set()
    assert 0.0 <= made.evaluate(state)["success_rate"] <= 1.0  # the program takes what was foreseen
    here = threading.current_thread()
    traced = [(name, thread is here) for name, thread in order]
    assert traced == [*((name, True) for name in ("starts", "rollout", "update", "init")), ("evaluation", False)]
    stages = {span.name: span for span in made.spans}
    assert stages["evaluation, compiled"].begun > stages["update, compiled"].begun


def test_an_evaluation_that_cannot_be_made_says_so_when_it_is_asked_for(monkeypatch):
    run = cfg.resolve("nero_reach", "default", None, {"episode_length_s": 0.2}, {"num_envs": 8}, impl="native")
    learner, lower = compiled.make_learner(run), Programs.lower

    def lowered(self, name, *rest, **options):
        if name.startswith("evaluation"):
            raise UserError("no room")
        return lower(self, name, *rest, **options)

    monkeypatch.setattr(Programs, "lower", lowered)
    made = compiled.compile(run, learner, 1, lambda: learner.init(jax.random.PRNGKey(0)), Programs(run, learner))
    for evaluate in (made.evaluate, made.evaluate.of_seed(3)):
        with pytest.raises(UserError, match="no room"):
            evaluate(made.state)


@pytest.mark.parametrize(("env", "learner"), [("nero_reach", "ppo"), ("nero_lift", "pixels"), ("nero_lift", "distill")])
def test_nothing_comes_to_the_device_before_the_first_state(monkeypatch, env, learner):
    """A GPU's first array takes two seconds, in which its memory is reserved. Shapes can be had without."""
    made, key = [], jax.random.PRNGKey

    def noted(seed):
        found = key(seed)
        made.append(isinstance(found, jax.core.Tracer))
        return found

    preset = "rgb" if learner != "ppo" else "default"
    run = cfg.resolve(env, preset, None, {}, {"num_envs": 8}, impl="native", learner=learner)
    monkeypatch.setattr(jax.random, "PRNGKey", noted)
    found = compiled.make_learner(run)
    found.footprint()
    state_shape(found)
    assert made and all(made)


class Slow(starts.Maker):
    """An expert that takes until the first state's program is compiled."""

    def __init__(self, programs, gives):
        self.programs, self.gives = programs, gives

    def shapes(self):
        return {"bank": np.zeros(3, np.float32)}

    def __call__(self, seed):
        for _ in range(600):
            if any("init" in name for name in self.programs):
                return self.gives
            time.sleep(0.05)
        raise AssertionError("the program waits for the expert")


@pytest.mark.parametrize("able", [True, False])
def test_the_first_state_compiles_beside_the_expert(able, programs):
    """If the expert cannot do the task after all, another program makes the state."""

    def init(key, bank=None):
        return key[1] + (0.5 if bank is None else bank.sum())

    bank = {"bank": np.arange(3, dtype=np.float32)}
    start = compiled.Fresh(types.SimpleNamespace(init=init), Slow(programs, bank if able else {}))
    assert float(start(7)) == (10.0 if able else 7.5) and float(start(8)) == (11.0 if able else 8.5)
    assert sum("init" in name for name in programs) == (1 if able else 2)


def test_the_first_states_program_is_traced_and_compiled_before_the_experts(programs):
    """What comes between is a GPU's kernels. XLA takes longer for the first state than an expert for its episodes."""
    traced = []
    expert = Slow(programs, {})
    expert.trace = traced.append
    fresh = compiled.Fresh(types.SimpleNamespace(init=lambda key, bank=None: key[1] + bank.sum()), expert)
    with concurrent.futures.ThreadPoolExecutor() as beside:
        steps = fresh.trace(3, beside)
        next(steps)
    assert not traced and sum("init" in name for name in programs) == 1  # the pool has ended, so it has compiled
    assert list(steps) == [] and traced == [3]


def test_an_experts_program_is_for_the_processor(monkeypatch):
    """So that every machine gets the same states, whatever traces it."""
    asked = []

    class Player:
        able = keeps = True

        def __init__(self, *_):
            pass

        def trace(self, seed):
            asked.append((seed, jax.config.jax_default_device))

    monkeypatch.setattr(starts, "_Player", Player)
    imitates = types.SimpleNamespace(env=types.SimpleNamespace(unwrapped=None), num_envs=8, imitates=True)
    starts.Maker(imitates, print).trace(3)
    starts.Maker(types.SimpleNamespace(env=None), print).trace(3)  # nothing to trace
    assert asked == [(3, machines.processor())] and jax.config.jax_default_device is None


def test_programs_are_lowered_small_by_one_thread_at_a_time():
    """The setting is the process's: a second thread would take the first one's for its own."""
    name, found = "jax_threefry_gpu_kernel_lowering", []
    before = getattr(jax.config, name)

    def lower(_):
        with machines.small():
            time.sleep(0.02)
            found.append(getattr(jax.config, name))

    with concurrent.futures.ThreadPoolExecutor() as pool:
        list(pool.map(lower, range(4)))
    assert found == [True] * 4 and getattr(jax.config, name) == before


def test_two_threads_make_a_physics_once(monkeypatch):
    made, both = [], threading.Barrier(2)

    def make(*given):
        time.sleep(0.1)
        made.append(physics.make_physics(*given))
        return made[-1]

    monkeypatch.setattr(env, "make_physics", make)
    own = env.ManipulationEnv(registry.env_cfg("nero_reach"), "native")

    def ask():
        both.wait()
        return own.physics

    with concurrent.futures.ThreadPoolExecutor() as pool:
        first, second = (call.result() for call in [pool.submit(ask), pool.submit(ask)])
    assert first is second and len(made) == 1


def test_a_log_is_written_without_pytorch(tmp_path):
    """Its import takes seconds, and TensorBoard's writer would do it for tensors alone."""
    (tmp_path / "torch.py").write_text("raise SystemExit('imported')")
    code = """
import pathlib, sys
from mjx_nero.runs.logs import Logs
logs = Logs(pathlib.Path("."), print)
logs.write({"steps": 1, "loss": 2.0})
assert "tensorboardX" in sys.modules and not logs.lost
"""
    path = os.pathsep.join((str(tmp_path), str(ROOT)))
    subprocess.run([sys.executable, "-c", code], check=True, cwd=tmp_path, env={**os.environ, "PYTHONPATH": path})
    assert (tmp_path / "tensorboard").is_dir()


def test_brax_is_whole_for_others():
    code = """
import mjx_nero.envs.env
import brax.envs, brax.generalized.pipeline
assert issubclass(mjx_nero.envs.env.ManipulationEnv, brax.envs.Env) and brax.envs.base.Env is brax.envs.Env
assert brax.envs.ant.Ant is brax.envs._envs["ant"]
from brax.envs.base import g_pipeline
assert g_pipeline.step is brax.generalized.pipeline.step
import scipy.spatial, trimesh
from mujoco.mjx._src import mesh
assert mesh.spatial.ConvexHull is scipy.spatial.ConvexHull and mesh.trimesh.Trimesh is trimesh.Trimesh
"""
    subprocess.run([sys.executable, "-W", "ignore", "-c", code], check=True, cwd=ROOT, env={**os.environ, "JAX_PLATFORMS": "cpu"})


def test_reading_a_file_compiles_nothing(programs, tmp_path):
    tree = {str(n): np.full((n, 3), n, np.float32) for n in range(31, 37)}  # shapes that no other test has
    checkpoint.save(tmp_path / "a.safetensors", tree, {})
    found = checkpoint.load(tmp_path / "a.safetensors", tree)
    assert not programs
    for name, value in tree.items():
        assert isinstance(found[name], jax.Array) and found[name].dtype == np.float32
        np.testing.assert_array_equal(found[name], value)


@pytest.mark.parametrize("seed", [0, 1, 2**31 + 5, 2**32 - 1])
def test_keys_of_episodes_are_one_program(programs, seed):
    keys, key = rollout._keys(np.uint32(seed), 37)
    assert set(programs) <= {"jit(_keys)"}
    k_reset, own = jax.random.split(jax.random.fold_in(jax.random.PRNGKey(seed), 0xE7A1))
    np.testing.assert_array_equal(keys, jax.random.split(k_reset, 37))
    np.testing.assert_array_equal(key, own)
