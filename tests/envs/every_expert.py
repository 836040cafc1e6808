"""Experts of which the suite plays the like: pytest tests/envs/every_expert.py. The guides have figures over 200 episodes."""

import pytest

from mjx_nero.runs import evaluation


@pytest.mark.parametrize(
    ("name", "preset", "robot", "episodes", "least"),
    [
        ("nero_insert_peg", "default", None, 24, 0.8),
        ("nero_open_drawer", "default", None, 24, 0.9),
        ("piper_open_door", "default", None, 24, 0.85),
        ("nero_reorient", "default", None, 24, 0.75),
        ("nero_clutter", "default", None, 32, 28 / 32),
        ("stack", "default", "piper", 8, 1.0),
        ("nero_follow_target", "default", None, 8, 1.0),
    ],
)
def test_it_succeeds(name, preset, robot, episodes, least):
    cfg = evaluation.EvalCfg(name, preset, robot, controller="expert", episodes=episodes, backend="mujoco")
    found = evaluation.play(cfg).result
    assert found["success_rate"] >= least and found["nan_count"] == 0
