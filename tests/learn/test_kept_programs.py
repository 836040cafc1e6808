"""A later start reads the programs that an earlier one has lowered, traces none of them, and computes the same to the bit."""

import dataclasses

import jax
import numpy as np
import pytest

from mjx_nero.learn.ppo.learner import Learner
from mjx_nero.runs import cfg, compiled, kept, programs
from mjx_nero.runs.programs import _settings as settings

pytestmark = pytest.mark.skipif(jax.default_backend() != "cpu", reason="of MuJoCo's C library in CPU programs")
FIELDS = {"num_envs": 8, "unroll_length": 4, "num_minibatches": 2, "num_epochs": 1}
FIELDS |= {"network.actor": (8,), "network.critic": (8,)}
WHOLE = ["init", "rollout", "starts", "totals", "update"]


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(programs, "_settings", settings)
    return tmp_path / "mjx_nero" / "programs"


@pytest.fixture
def traced(monkeypatch):
    """The names of the functions that are traced to be kept."""
    names: list[str] = []
    exported = programs._exported

    def noted(function, *rest):
        names.append(function.__name__)
        return exported(function, *rest)

    monkeypatch.setattr(programs, "_exported", noted)
    return names


def asked(**changes):
    run = cfg.resolve("nero_reach", "default", None, {"episode_length_s": 0.2}, {**FIELDS, **changes}, impl="native")
    return dataclasses.replace(run, eval_episodes=2)


def started(run):
    """Starts a run; returns its parts, with what two calls of its program and its evaluation give, as bytes."""
    learner = compiled.make_learner(run)
    shelved = programs.Programs(run, learner)
    start = compiled.Fresh(learner, None, shelved)
    made = compiled.compile(run, learner, 1, lambda: start.placed(run.seed), shelved)
    state, metrics = made.advance(made.advance(made.state)[0])
    told = [np.asarray(x).tobytes() for x in jax.tree.leaves((state, metrics))]
    return made, told, made.evaluate(state)


def read_or_lowered(run, learner=None):
    """Lowers a small function as a program of a run."""
    learner = learner or compiled.make_learner(run)

    def small(x):
        return x + 1, {"twice": 2 * x}

    args = (jax.ShapeDtypeStruct((3,), np.float32),)
    lowered = programs.Programs(run, learner).lower("small", small, args, args[0], learner.env.unwrapped, donate=(0,))
    whole, named = lowered.compile()(np.ones(3, np.float32))
    assert whole.tolist() == [2.0] * 3 and named["twice"].tolist() == [2.0] * 3


@pytest.mark.slow
def test_a_later_start_traces_nothing_and_computes_the_same(traced, folder, monkeypatch):
    first, told, evaluation = started(asked())
    assert sorted(traced) == WHOLE and len(list(folder.iterdir())) == 6  # five programs and the state
    state = sum(x.nbytes for x in jax.tree.leaves(first.learner.init(jax.random.PRNGKey(0))))
    assert all(each.memory_analysis().alias_size_in_bytes > 0.9 * state for each in first.advance.programs)

    def refuse(*_):
        raise AssertionError("traced")

    with monkeypatch.context() as blind:
        blind.setattr(Learner, "_with_starts", refuse)
        blind.setattr(Learner, "rollout", refuse)
        blind.setattr(Learner, "_update", refuse)
        blind.setattr(Learner, "act", refuse)
        _, again, evaluated = started(asked())
    assert again == told and evaluated == evaluation and sorted(traced) == WHOLE
    (one,) = folder.glob("*-update.safetensors")  # what it takes is known from the part before, which is read
    one.unlink()
    assert started(asked())[1] == told and sorted(traced) == sorted([*WHOLE, "update"])
    traced.remove("update")
    monkeypatch.setattr(kept.cache, "folder", lambda: None)
    _, without, evaluated = started(asked())
    assert without == told and evaluated == evaluation and sorted(traced) == WHOLE


@pytest.mark.slow
def test_the_first_state_of_a_seed_is_kept(folder, monkeypatch):
    lowered, lower = [], programs.Programs.lower

    def noted(self, name, *rest, **options):
        lowered.append(name.partition("-")[0])
        return lower(self, name, *rest, **options)

    monkeypatch.setattr(programs.Programs, "lower", noted)
    run = asked()
    _, told, _ = started(run)
    assert sorted(lowered) == ["evaluation", "init", "rollout", "starts", "update"]
    (state,) = folder.glob("*-state-0.safetensors")
    lowered.clear()
    assert started(run)[1] == told and sorted(lowered) == ["evaluation", "rollout", "starts", "update"]
    data = state.read_bytes()
    state.write_bytes(data[:-9] + bytes([data[-9] ^ 1]) + data[-8:])
    lowered.clear()
    assert started(run)[1] == told and "init" in lowered
    lowered.clear()
    assert started(run)[1] == told and "init" not in lowered
    assert started(dataclasses.replace(run, seed=7))[1] != told and len(list(folder.glob("*-state-7.safetensors"))) == 1
    monkeypatch.setattr(programs, "_LARGEST", 10)
    started(dataclasses.replace(run, seed=8))
    assert not list(folder.glob("*-state-8.safetensors"))


def test_what_a_program_depends_on(traced, folder, monkeypatch, tmp_path):
    run = asked()
    for _ in range(2):
        read_or_lowered(run)
    read_or_lowered(dataclasses.replace(run, seed=7, out=tmp_path))
    assert len(traced) == 1
    read_or_lowered(asked(num_envs=16))
    read_or_lowered(asked(discounting=0.9))
    read_or_lowered(dataclasses.replace(run, env=dataclasses.replace(run.env, episode_length_s=0.4)))
    assert len(traced) == 4
    with jax.default_matmul_precision("float32"):
        read_or_lowered(run)
    source = tmp_path / "source"
    source.mkdir()
    monkeypatch.setattr(kept, "_HERE", source)
    (source / "code.py").write_text("one")
    read_or_lowered(run)
    (source / "code.py").write_text("more")
    read_or_lowered(run)
    assert len(traced) == 7


def test_a_damaged_program_is_made_anew(traced, folder):
    run = asked()
    read_or_lowered(run)
    (file,) = folder.iterdir()
    data = file.read_bytes()
    file.write_bytes(data[:-9] + bytes([data[-9] ^ 1]) + data[-8:])
    for _ in range(2):
        read_or_lowered(run)
    assert len(traced) == 2


def test_what_is_not_kept(traced, folder, monkeypatch):
    run = asked()
    learner = compiled.make_learner(run)

    class Guest(Learner):
        pass

    guest = Guest(learner.env, run.hyperparameters)
    read_or_lowered(run, guest)
    several = compiled.make_learner(run)
    several.num_devices = 2
    read_or_lowered(run, several)
    monkeypatch.setattr(kept.cache, "folder", lambda: None)
    read_or_lowered(run)
    assert not traced and not folder.exists()


def test_what_cannot_be_exported_is_lowered_as_ever(folder):
    run = asked()
    learner = compiled.make_learner(run)

    def back(x):
        return jax.pure_callback(lambda x: x + 1, x, x), {}

    args = (jax.ShapeDtypeStruct((3,), np.float32),)
    lowered = programs.Programs(run, learner).lower("back", back, args, args[0], learner.env.unwrapped)
    assert lowered.compile()(np.ones(3, np.float32))[0].tolist() == [2.0] * 3 and not folder.exists()
