"""Cloning: the network comes to the demonstrated actions, by the same commands as any learner."""

import json

import numpy as np
import pytest
from kinematic import Kinematic

import mjx_nero
from mjx_nero import ManipulationEnv
from mjx_nero.data import Episode, Feature, Schema, writer
from mjx_nero.data.episode import DONE_BY, SEEN
from mjx_nero.learn import policy


@pytest.fixture
def demonstrations(tmp_path, monkeypatch):
    """Of a demonstrator whose actions are a linear function of what it sees, beyond what an arm can do now and then."""
    monkeypatch.setattr(ManipulationEnv, "physics", Kinematic())
    env = mjx_nero.make("nero_lift", impl="native")
    size, rng = env.observation_size["state"][0], np.random.default_rng(0)
    weights = rng.normal(size=(size, env.action_size)).astype(np.float32) / size**0.5

    def episode(number: int) -> Episode:
        seen = rng.normal(size=(50, size)).astype(np.float32) + 3
        return Episode({SEEN: seen, DONE_BY: seen @ weights - 3 * weights.sum(axis=0)}, True, number)

    features = {SEEN: Feature(("x",) * size), DONE_BY: Feature(("a",) * env.action_size)}
    about = {"env": "nero_lift", "preset": "default", "through": "task"}
    made, schema = [episode(i) for i in range(20)], Schema(50.0, "nero", "Lift.", features, about)
    for name, part in (("d", made), ("first", made[:15]), ("second", made[15:])):
        with writer(tmp_path / name, schema, "arrays") as out:
            out.put(part)
    return weights


SIZES = ["--learner", "clone", "--env.episode_length_s", 0.1, "--num-envs", 4, "--eval-every", 10**9, "--no-video"]
SMALL = ["--clone.minibatch_size", 64, "--clone.updates", 50, "--clone.network.actor", "64,64"]


def test_the_action_for_what_was_seen_is_learnt(demonstrations, call, tmp_path):
    argv = [*SIZES, *SMALL, "--clone.data", "d", "--num-timesteps", 64 * 50 * 120]
    code, out, err = call("train", *argv, "--out", "run")
    assert code == 0, err
    rows = [json.loads(line) for line in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()]
    losses = [row["clone/loss"] for row in rows if "clone/loss" in row]
    assert losses[0] > 0.1 and losses[-1] < 0.02
    trained = policy.checkpoint_policy(tmp_path / "run" / "policy.safetensors")
    seen = np.random.default_rng(1).normal(size=(200, len(demonstrations))).astype(np.float32) + 3
    wanted = np.clip((seen - 3) @ demonstrations, -1, 1)  # an arm cannot do more
    assert np.abs(np.asarray(trained.act({"state": seen})) - wanted).mean() < 0.1
    assert trained.meta["learner"] == "clone"


def test_a_run_goes_on_to_the_bit(demonstrations, call, tmp_path):
    argv = [*SIZES, *SMALL, "--clone.data", "d", "--num-timesteps", 64 * 50 * 6]
    assert call("train", *argv, "--out", "whole")[0] == 0
    code, _, err = call("train", *argv, "--out", "run", "--checkpoint-every", 64 * 50 * 2)
    assert code == 0, err
    middle = sorted((tmp_path / "run" / "checkpoints").glob("*.safetensors"))[1]
    code, _, err = call("train", *argv, "--restore", middle, "--out", "again")
    assert code == 0, err
    whole, again = (policy.checkpoint_policy(tmp_path / name / "policy.safetensors") for name in ("whole", "again"))
    seen = np.ones((3, len(demonstrations)), np.float32)
    np.testing.assert_array_equal(whole.act({"state": seen}), again.act({"state": seen}))


def test_several_folders_are_one(demonstrations, call, tmp_path):
    argv = [*SIZES, *SMALL, "--num-timesteps", 64 * 50]
    for out, data in (("one", "d"), ("two", "first,second")):
        code, _, err = call("train", *argv, "--clone.data", data, "--out", out)
        assert code == 0, err
    one, two = (policy.checkpoint_policy(tmp_path / name / "policy.safetensors") for name in ("one", "two"))
    seen = np.ones((3, len(demonstrations)), np.float32)
    np.testing.assert_array_equal(one.act({"state": seen}), two.act({"state": seen}))


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        ([], "--learner clone learns from demonstrations: pass --clone.data DIR, a folder that 'demos' wrote"),
        (["--clone.data", "d,nowhere"], "nowhere holds no demonstrations of mjx_nero"),
        (["--clone.data", "d", "--preset", "isaac"], "but a policy here has"),
        (["--clone.data", "d", "--num-devices", 2], "--learner clone learns on one device"),
    ],
)
def test_mistakes(demonstrations, call, argv, message):
    code, _, err = call("train", *SIZES, *argv, "--num-timesteps", 100)
    assert code == 2 and message in err and err.count("\n") == 1
