"""The policies that ship, in MuJoCo's C library. Figures over 1,000 episodes: docs/results.md."""

import pytest

from mjx_nero import list_envs
from mjx_nero.learn import evaluation, policy
from mjx_nero.tools import results

NAMES = [name for name in list_envs() if policy.shipped(name).exists()]


def test_every_task_that_is_to_be_learnt_has_one_but_one():
    assert set(results.learnable()) - set(NAMES) == {"cobotta_stack"}


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_it_succeeds(name):
    """Over 1,000 episodes they do 91% and more, reaches 98% and more; few leave room for chance."""
    few = 64 if name.endswith(("_reach", "_lift")) else 24
    found = evaluation.play(evaluation.EvalCfg(name, agent="policy", episodes=few, backend="mujoco")).result
    assert found["success_rate"] >= (0.93 if name.endswith("_reach") else 0.8)
