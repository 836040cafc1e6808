"""The policies that ship, in MuJoCo's C library. Figures over 1,000 episodes: docs/benchmarks.md."""

import pytest

from mjx_nero import list_envs
from mjx_nero.learn import policy
from mjx_nero.learn.play import evaluation
from mjx_nero.tools import results

NAMES = [name for name in list_envs() if policy.shipped(name).exists()]


# Nobody has trained these by the default command.
ARMS = ("nero", "cobotta", "piper", "so100", "so101")
MISSING = {
    *(f"{arm}_hang_ring" for arm in ARMS),
    *(f"{arm}_insert_peg" for arm in ARMS if arm != "cobotta"),
    *(f"{arm}_reorient" for arm in ("nero", "cobotta", "piper")),
    *(f"{arm}_{task}" for arm in ("piper", "so100", "so101") for task in ("open_door", "turn_knob")),
    *(f"{arm}_{task}" for arm in ("so100", "so101") for task in ("open_drawer", "lift_any")),
    "piper_reach_obstacles",
}


def test_every_task_that_is_to_be_learnt_has_one():
    """But for those that are known to be missing, none of which is there."""
    assert set(results.learnable()) == set(NAMES) | MISSING and not MISSING & set(NAMES)


REAL = [name for name in NAMES if policy.shipped(name, "sim2real") != policy.shipped(name)]


def test_lifts_and_reaches_have_one_for_the_real_arm():
    assert set(REAL) == {*(f"{arm}_lift" for arm in ("nero", "cobotta", "piper", "so101")), "nero_reach", "cobotta_reach"}


@pytest.mark.slow
@pytest.mark.parametrize("name", REAL)
def test_it_succeeds_where_everything_differs(name):
    found = evaluation.play(evaluation.EvalCfg(name, preset="sim2real", agent="policy", episodes=64, backend="mujoco")).result
    assert found["success_rate"] >= (0.7 if name.startswith("so101") else 0.85)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_it_succeeds(name):
    """Over 1,000 episodes they do 91% and more, reaches 98% and more; few leave room for chance."""
    few = 64 if name.endswith(("_reach", "_lift")) else 24
    found = evaluation.play(evaluation.EvalCfg(name, agent="policy", episodes=few, backend="mujoco")).result
    assert found["success_rate"] >= (0.93 if name.endswith("_reach") else 0.8)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["nero_lift", "piper_lift"])
def test_it_succeeds_by_sight(name):
    """Every episode looks different. MuJoCo Warp's ray tracer draws, as in training: OpenGL in software would take minutes."""
    fields = {"scene.renderer": "warp"}
    cfg = evaluation.EvalCfg(name, preset="rgb", agent="policy", episodes=16, backend="mujoco", env_fields=fields)
    assert evaluation.play(cfg).result["success_rate"] >= 0.7
