"""Every bundled policy in MuJoCo's C library: pytest tests/envs/every_policy.py. ``test_shipped.py`` plays some of them."""

import pytest

from mjx_nero import list_envs
from mjx_nero.learn import policy
from mjx_nero.runs import evaluation

NAMES = [name for name in list_envs() if policy.shipped(name).exists()]
REAL = [name for name in NAMES if policy.shipped(name, "sim2real") != policy.shipped(name)]
SIGHT = [name for name in NAMES if policy.shipped(name, "rgb") != policy.shipped(name)]


@pytest.mark.parametrize("name", NAMES)
def test_it_succeeds(name):
    """Over 1,000 episodes they do 91% and more, reaches 98% and more; few leave room for chance."""
    few = 64 if name.endswith(("_reach", "_lift")) else 24
    found = evaluation.play(evaluation.EvalCfg(name, agent="policy", episodes=few, backend="mujoco")).result
    assert found["success_rate"] >= (0.93 if name.endswith("_reach") else 0.8)


@pytest.mark.parametrize("name", REAL)
def test_it_succeeds_where_everything_differs(name):
    found = evaluation.play(evaluation.EvalCfg(name, preset="sim2real", agent="policy", episodes=64, backend="mujoco")).result
    assert found["success_rate"] >= (0.7 if name.startswith("so101") else 0.85)


@pytest.mark.parametrize("name", SIGHT)
def test_it_succeeds_by_sight(name, episodes=16):
    """Every episode looks different. MuJoCo Warp's ray tracer draws, as in training: OpenGL in software would take minutes."""
    fields = {"scene.renderer": "warp"}
    cfg = evaluation.EvalCfg(name, preset="rgb", agent="policy", episodes=episodes, backend="mujoco", env_fields=fields)
    assert evaluation.play(cfg).result["success_rate"] >= 0.7
