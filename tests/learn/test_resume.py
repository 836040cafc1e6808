"""Going on: what fits a run, and what is said in words where it does not."""

import pathlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_nero import UserError
from mjx_nero.config.registry import Registry
from mjx_nero.learn import checkpoint, learner
from mjx_nero.learn.learner import Kind
from mjx_nero.runs import compiled, resume

META = {
    "env": "nero_lift",
    "preset": "default",
    "robot": "nero",
    "fingerprint": "a1",
    "learner": "ppo",
    "num_envs": 64,
    "observations": {"state": ["joint_pos"]},
    "observation_size": {"state": [9]},
    "action_size": 8,
    "network": {"actor": [8], "output_scale": 0.01},
}
WORDS = [
    ({"env": "nero_reach"}, "is a checkpoint of nero_reach, not of nero_lift: pass --env nero_reach"),
    ({"robot": "piper"}, "is a checkpoint for piper, not for nero: pass the --robot that it was trained with"),
    ({"fingerprint": "b2"}, "is a checkpoint for another model of nero: pass the --robot"),
    ({"num_envs": 32}, "does not fit: it holds 32 environments, this run has 64: pass --num-envs 32"),
    ({"learner": "search"}, "was made by the learner search: pass --learner"),
    ({"preset": "sim2real", "actions": ["JointVelocity"]}, r"\(preset sim2real\) on other observations or actions"),
    ({"preset": "isaac", "action_size": 7}, r"was trained in nero_lift \(preset isaac\) on other observations or actions"),
    ({"network": {"actor": [16, 8]}}, r"because its networks differ: pass --ppo.network.actor '16,8'$"),
]


@pytest.mark.parametrize(("changes", "words"), WORDS, ids=[next(iter(c)) for c, _ in WORDS])
def test_what_does_not_fit_is_said_in_words(changes, words):
    source = resume.Source(pathlib.Path("x.safetensors"), {**META, **changes, "kind": "checkpoint"})
    with pytest.raises(UserError, match=f"^x.safetensors .*{words}"):
        resume.check(source, META)


def test_what_networks_of_older_versions_lack():
    """They bound no observation; the scale of first weights is of no matter to who brings weights."""
    old, new = {**META, "network": {"actor": [8]}, "kind": "policy"}, {**META["network"], "max_observation": 10.0}
    with pytest.raises(UserError, match=r"because its networks differ: pass --ppo.network.max_observation 0.0$"):
        resume.check(resume.Source(pathlib.Path("x"), old), {**META, "network": new})
    resume.check(resume.Source(pathlib.Path("x"), old), {**META, "network": {**new, "max_observation": 0.0}})


def test_what_fits():
    resume.check(resume.Source(pathlib.Path("x"), {**META, "kind": "checkpoint"}), META)
    resume.check(resume.Source(pathlib.Path("x"), {"env": "nero_lift", "kind": "checkpoint"}), META)  # of an older version
    # Networks may start another task, another number of environments, another robot.
    resume.check(
        resume.Source(pathlib.Path("x"), {**META, "kind": "policy", "env": "nero_push", "num_envs": 1, "robot": "b"}), META
    )


class Learner:
    """Of three numbers, all of them its networks."""

    def init(self, key):
        return {"w": jnp.zeros(3)}

    def place(self, state):
        return state

    def policy(self, state):
        return state

    def with_policy(self, state, policy):
        return policy


@pytest.fixture
def three(monkeypatch):
    """``Learner`` by the name ``three``."""
    monkeypatch.setattr(learner, "KINDS", Registry("learner", learner.KINDS))
    template = {"w": jax.ShapeDtypeStruct((3,), np.float32)}
    learner.KINDS.add("three", Kind(make=Learner, presets={}, policy=lambda meta: (template, lambda params, obs: params)))


@pytest.mark.parametrize("kind", ["checkpoint", "policy"])
def test_networks_that_are_not_finite_are_refused(three, kind, tmp_path):
    path = tmp_path / "a.safetensors"
    for last in (3.0, np.nan, np.inf):
        checkpoint.save(path, {"w": np.array([1.0, 2.0, last], np.float32)}, {**META, "learner": "three", "kind": kind})
        source = resume.find(path, print)
        if np.isfinite(last):
            assert resume.state(source, compiled.Fresh(Learner()), 0)["w"].tolist() == [1.0, 2.0, 3.0]
        else:
            with pytest.raises(UserError, match=r"a.safetensors holds numbers that are not finite, in \['w'\]"):
                resume.state(source, compiled.Fresh(Learner()), 0)


def test_networks_of_other_sizes_are_refused(three, tmp_path):
    """A learner's own file describes networks that the run does not have."""
    path = tmp_path / "a.safetensors"
    checkpoint.save(path, {"w": np.zeros(3, np.float32)}, {**META, "learner": "three", "kind": "policy"})

    class Wider(Learner):
        def init(self, key):
            return {"w": jnp.zeros(4)}

    with pytest.raises(UserError, match=r"a.safetensors does not fit: \['w'\] is \(3,\), expected \(4,\)$"):
        resume.state(resume.find(path, print), compiled.Fresh(Wider()), 0)


@pytest.mark.parametrize(
    "fields", [{"num_envs": "8"}, {"tally": {"steps": None}}, {"tally": [1]}, {"env": "a\nb"}, {"network": 3}], ids=str
)
def test_fields_that_are_none_are_refused(fields):
    with pytest.raises(UserError, match=f"its {next(iter(fields))} is "):
        resume.check(resume.Source(pathlib.Path("x"), {**META, "kind": "checkpoint", **fields}), META)


def test_a_damaged_newest_checkpoint_is_passed_over(tmp_path):
    said: list[str] = []
    for steps in (0, 100, 200):
        checkpoint.save(tmp_path / "checkpoints" / f"{steps:012d}.safetensors", {"x": steps + np.zeros(9)}, META)
    newest = tmp_path / "checkpoints" / "000000000200.safetensors"
    data = bytearray(newest.read_bytes())
    data[-3] ^= 1  # one bit of one number
    newest.write_bytes(data)
    assert resume.find(tmp_path, said.append).path.name == "000000000100.safetensors"
    assert said == [f"warning: {newest} is damaged: using the checkpoint before it"]
    newest.write_bytes(data[:50])
    assert resume.find(tmp_path, said.append).path.name == "000000000100.safetensors"
    for path in newest.parent.iterdir():
        path.write_bytes(b"")
    with pytest.raises(UserError, match="holds no checkpoint to restore"):
        resume.find(tmp_path, said.append)
