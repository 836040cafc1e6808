"""Numbers that are within their bounds each, and whose product is not: one line before anything of that size is made."""

import resource

import numpy as np
import pytest

import mjx_nero
from mjx_nero import config
from mjx_nero.identify.plant import Plant
from mjx_nero.identify.simulate import RecordCfg
from mjx_nero.interop.gymnasium import VectorEnv
from mjx_nero.learn.play import rollout
from mjx_nero.types import UserError

_FIELDS = [name for name in config.flatten(mjx_nero.env_cfg("nero_lift")) if name.startswith("observations.")]
LONG = {name: 256 for name in _FIELDS if name.endswith(".history")}
LATE = {name: (0, 256) for name in _FIELDS if name.endswith(".delay")}


@pytest.fixture(autouse=True)
def _little_memory():
    """The process takes no gigabyte more than it has."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    yield
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 1_000_000


@pytest.mark.parametrize("fields", [LONG, LATE, LONG | LATE, {"episode_length_s": 5.0}], ids=["long", "late", "both", "many"])
def test_a_batch(fields):
    with pytest.raises(UserError, match=r"^num_envs 16,777,216 .* GB of memory, but .* GB are free: pass fewer"):
        VectorEnv("nero_lift", 2**24, impl="native", **fields)


def test_models_of_each_environment():
    """Where fields are drawn, MuJoCo's C library has a model for each."""
    drawn, same = (mjx_nero.make("nero_lift", preset, impl="native").physics.footprint() for preset in ("sim2real", "default"))
    assert drawn.in_program > same.in_program + 10_000


@pytest.mark.parametrize("episodes, record, seconds", [(1_000_000, 0, 20_000.0), (64, 64, 20_000.0), (1000, 1000, 20_000.0)])
def test_episodes(episodes, record, seconds, monkeypatch):
    from mjx_nero.learn import device_memory

    monkeypatch.setattr(device_memory, "_limit", lambda devices: 4e9)
    env = mjx_nero.make("nero_lift", impl="native", episode_length_s=seconds)
    with pytest.raises(UserError, match=r"^episodes: .* GB of records, .* shorter episodes"):
        rollout.runner(env, lambda params, obs, key: None, episodes, record)
    short = mjx_nero.make("nero_lift", impl="native")
    assert rollout.runner(short, lambda params, obs, key: None, 1000, 100)


def test_recordings():
    for fields in ({"seconds": 3600.0, "rate": 10_000.0}, {"seconds": 1e9}, {"delay": 1e6}, {"rate": 1e12}):
        with pytest.raises(UserError, match=r"must be|are more than 500,000 readings"):
            RecordCfg(**fields)
    plant = Plant(mjx_nero.env_cfg("nero_lift").robot, 1e-4)
    sent, targets = np.arange(3600.0), np.tile(plant.robot.arm.home, (3600, 1))
    with pytest.raises(UserError, match="too many physics steps"):
        plant.readings([plant.nominal] * 2, sent, targets, targets[0], sent)
