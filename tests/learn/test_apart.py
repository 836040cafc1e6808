"""An expert that plays, and kernels that are built, in processes of their own, while the run starts."""

import dataclasses
import os
import pathlib
import signal
import subprocess
import sys
import threading

import jax
import pytest
from safetensors.numpy import load
from waiting import wait

from mjx_nero.learn import checkpoint
from mjx_nero.runs import apart, cfg, compiled, starts
from mjx_nero.runs.programs import Programs

SIZES = {"num_envs": 8, "demonstrations": 2}
# Begins a run's expert apart and asks for what it plays, as ``train.py`` does. The argument: whether the process is killed.
SCRIPT = """
import sys
from mjx_nero.runs import apart, cfg, compiled, starts
apart.cores = lambda: 4
run = cfg.resolve("nero_lift", "default", None, {}, {"num_envs": 8, "demonstrations": 2}, impl="native")
helpers = apart.begin(run)
process = helpers.expert
assert process is not None and process.daemon and helpers.kernels is None
if sys.argv[1] == "killed":
    process.kill()
said = []
maker = starts.Maker(compiled.make_learner(run), said.append, elsewhere=process)
maker.trace(0)
assert not process.is_alive() or "_lowered" not in vars(maker._player)
given = maker(0)
assert sorted(given) == sorted(maker.names) and "noisy tries" in said[0], said
print("played here" if "_lowered" in vars(maker._player) else "read", process.exitcode)
"""

# Begins a run's expert apart, says what process plays it, and is killed.
KILLED = """
import os, signal
from mjx_nero.runs import apart, cfg
apart.cores = lambda: 4
helpers = apart.begin(cfg.resolve("nero_lift", "default", None, {}, {"num_envs": 8, "demonstrations": 2}, impl="native"))
print(helpers.expert.pid, flush=True)
os.kill(os.getpid(), signal.SIGKILL)
"""


def run_of(**changes):
    return dataclasses.replace(cfg.resolve("nero_lift", "default", None, {}, SIZES, impl="native"), **changes)


def kept_by(home, how):
    """Runs the script with a cache of its own; returns what it says, and the file of episodes that it leaves."""
    env = {**os.environ, "XDG_CACHE_HOME": str(home), "JAX_PLATFORMS": "cpu"}
    done = subprocess.run([sys.executable, "-c", SCRIPT, how], env=env, capture_output=True, text=True, timeout=300, check=True)
    (file,) = (home / "mjx_nero" / "experts").glob("*.safetensors")
    arrays = {name: x.tobytes() for name, x in load(file.read_bytes()).items()}  # a file's order of them is chance
    return done.stdout.strip(), (file.name, arrays, checkpoint.load_meta(file))


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="forks on Linux alone")
def test_what_is_played_apart_is_what_the_run_would_play(tmp_path):
    said, apart_from = kept_by(tmp_path / "a", "left")
    assert said == "read 0"
    said, here = kept_by(tmp_path / "b", "killed")  # then this process plays
    assert said.startswith("played here -9") and here == apart_from


def _ended(pid):
    """True if a process is gone, or only waits for someone to read how it ended."""
    stat = pathlib.Path(f"/proc/{pid}/stat")
    return not stat.exists() or stat.read_text().rpartition(")")[2].split()[0] == "Z"


@pytest.mark.skipif(sys.platform != "linux", reason="forks on Linux alone")
def test_it_ends_with_its_run(tmp_path):
    """However that ends, and without holding what reads the run's output."""
    env = {**os.environ, "XDG_CACHE_HOME": str(tmp_path), "JAX_PLATFORMS": "cpu"}
    done = subprocess.run([sys.executable, "-c", KILLED], env=env, stdout=subprocess.PIPE, text=True, timeout=60)
    assert done.returncode == -signal.SIGKILL
    wait(lambda: _ended(int(done.stdout)), seconds=3.0)  # it would play for longer


@pytest.fixture
def forked(monkeypatch):
    """What would be forked, on a Linux machine with eight cores that does nothing else."""
    found = []

    class Context:
        def Process(self, target, args, daemon):
            assert target is apart._quietly and daemon
            return type("Process", (), {"start": lambda self: found.append(args[0])})()

    monkeypatch.setattr(apart.multiprocessing, "get_context", lambda how: {"fork": Context()}[how])
    monkeypatch.setattr(apart.sys, "platform", "linux")
    monkeypatch.setattr(apart, "cores", lambda: 8)
    monkeypatch.setattr(apart, "_is_busy", lambda: False)
    return found


@pytest.mark.parametrize(
    ("change", "begins"),
    [({}, True), ({"cores": 4}, True), ({"cores": 3}, False), ({"busy": True}, False), ({"restore": "run"}, False)],
)
def test_an_expert_plays_apart_only_where_it_can_and_helps(monkeypatch, tmp_path, forked, change, begins):
    monkeypatch.setattr(apart, "cores", lambda: change.get("cores", 8))
    monkeypatch.setattr(apart, "_is_busy", lambda: change.get("busy", False))
    helpers = apart.begin(run_of(restore=tmp_path if "restore" in change else None))
    assert (helpers.expert is not None) == begins and forked == [apart._play] * begins and helpers.kernels is None


def test_a_task_without_an_expert_begins_none(forked):
    assert apart.begin(cfg.resolve("nero_reach", "default", None, {}, {"num_envs": 8}, impl="native")) == apart.ALONE
    assert not forked


@pytest.mark.parametrize(
    ("change", "builds"),
    [
        ({}, True),
        ({"impl": "warp"}, True),
        ({"platforms": "cuda,cpu"}, True),
        ({"impl": "native"}, False),
        ({"platforms": "cpu"}, False),
        ({"gpus": []}, False),
        ({"plugins": []}, False),
        ({"warp": None}, False),
        ({"cores": 7}, False),
    ],
)
def test_kernels_are_built_apart_only_for_a_gpu(monkeypatch, forked, change, builds):
    plugins = [type("Plugin", (), {"name": name}) for name in change.get("plugins", ["xla_cuda13"])]
    monkeypatch.setattr(apart.glob, "glob", lambda _: change.get("gpus", ["/dev/nvidia0"]))
    monkeypatch.setattr(apart.metadata, "entry_points", lambda group: {"jax_plugins": plugins}[group])
    monkeypatch.setattr(apart.importlib.util, "find_spec", lambda name: {"warp": change.get("warp", "there")}[name])
    monkeypatch.setattr(apart, "cores", lambda: change.get("cores", 8))
    monkeypatch.setenv("JAX_PLATFORMS", change.get("platforms", ""))
    helpers = apart.begin(run_of(impl=change.get("impl", "auto")))
    assert (helpers.kernels is not None) == builds and forked == [apart._build] * builds + [apart._play]


@pytest.mark.parametrize("shared", [True, False])
def test_kernels_are_built_once_and_only_on_a_gpu_that_can_be_shared(monkeypatch, tmp_path, shared):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(apart, "_is_shared", lambda: shared)
    built = []

    class Env:
        def __init__(self, task, impl):
            assert impl == "native"  # JAX has no GPU there
            self.physics = self
            built.append(task)

        def prepare(self, num_envs):
            assert self.impl == "warp" and num_envs == 1

    monkeypatch.setattr(apart, "ManipulationEnv", Env)
    one, other = run_of().env, cfg.resolve("piper_lift", "default", None, {}, {}).env
    for task in (one, one, other, one):
        apart._build(run_of(env=task))
    assert built == ([one, other] if shared else [])


@pytest.mark.parametrize(("mode", "shared"), [(0, True), (3, False)])
def test_a_gpu_for_one_process_alone_is_left_to_it(monkeypatch, mode, shared):
    """A second process that opens it first would keep the run from it."""

    class Driver:
        def cuInit(self, flags):
            assert flags == 0

        def cuDeviceGetAttribute(self, found, attribute, device):
            assert attribute == 20 and device == 0
            found._obj.value = mode

    monkeypatch.setattr(apart.ctypes, "CDLL", lambda name: {"libcuda.so.1": Driver()}[name])
    assert apart._is_shared() == shared


def test_the_physics_waits_for_its_kernels(monkeypatch):
    did = []

    class Building:
        def join(self, seconds):
            assert seconds >= 60.0
            did.append("waited")

        def kill(self):
            did.append("ended")

    run = cfg.resolve("nero_reach", "default", None, {}, {"num_envs": 8}, impl="native", eval_episodes=2)
    learner = compiled.make_learner(run)
    monkeypatch.setattr(compiled.device_memory, "check_outside", lambda _: did.append("checked"))
    monkeypatch.setattr(learner.env.unwrapped, "prepare", lambda *_: did.append("prepared"))
    fresh = compiled.Fresh(learner)
    compiled.compile(
        run, learner, 1, lambda: fresh.placed(0), Programs(None, learner), lambda beside: fresh.trace(0, beside), Building()
    )
    assert did == ["waited", "ended", "checked", "prepared"]


def test_a_process_that_computes_is_not_forked(monkeypatch):
    jax.block_until_ready(jax.numpy.zeros(1))
    assert apart._is_busy()
    monkeypatch.setattr(sys.modules["jax._src.xla_bridge"], "backends_are_initialized", lambda: False)
    alone = threading.active_count() == 1
    assert apart._is_busy() == (not alone)
    monkeypatch.setattr(threading, "active_count", lambda: 1)
    assert not apart._is_busy()
    monkeypatch.setattr(jax.distributed, "is_initialized", lambda: True)
    assert apart._is_busy()


class Elsewhere:
    """A process that plays for so long, or for ever."""

    def __init__(self, ends, shelf):
        self.ends, self.shelf, self.killed = ends, shelf, False

    def join(self, seconds):
        assert seconds >= 60.0
        self.shelf.add(3) if self.ends else None

    def kill(self):
        self.killed = True


@pytest.mark.parametrize(("ends", "keeps"), [(True, True), (False, True), (False, False)])
def test_a_process_that_cannot_hand_over_is_not_waited_for(monkeypatch, ends, keeps):
    shelf, played, traced = set(), [], []

    class Player:
        able = True

        def __init__(self, *_):
            pass

        def kept(self, seed):
            return seed in shelf

        def trace(self, seed):
            traced.append(seed)

        def __call__(self, seed):
            played.append((seed, seed in shelf))
            raise starts.UserError("enough")

    Player.keeps = keeps
    monkeypatch.setattr(starts, "_Player", Player)
    process = Elsewhere(ends, shelf)
    imitates = type("Imitates", (), {"imitates": True, "num_envs": 8, "env": type("Env", (), {"unwrapped": None})()})()
    maker = starts.Maker(imitates, lambda _: None, elsewhere=process)
    maker.trace(3)
    assert maker(3) == {} and played == [(3, ends)] and process.killed == keeps and traced == ([] if keeps else [3])
    maker.trace(4)  # the next seed's expert plays here
    assert maker(4) == {} and traced[-1] == 4 and len(played) == 2
