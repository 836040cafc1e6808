"""Regions that no hand comes near are told, and those of the package's own tasks are not."""

import warnings

import pytest

from mjx_nero import make
from mjx_nero.envs import reach
from mjx_nero.sim import scene
from mjx_nero.tasks import registry


def said(env, **fields):
    cfg = registry.env_cfg(env, **fields)
    return reach.beyond(cfg, scene.build(cfg.robot, cfg.scene, cfg.sim, visuals=False, fuse=True))


@pytest.mark.parametrize("env", registry.list_envs())
def test_the_tasks_own_regions_are_in_reach(env):
    assert said(env, **({} if registry.robot_of(env) else {"robot": "piper"})) == ""


@pytest.mark.parametrize(
    ("env", "field", "value", "where"),
    [
        ("nero_reach", "command.params.x", (5.0, 6.0), r"command.params is out of reach: .* 5\.\d+ m to \(6.00"),
        ("nero_lift", "command.params.z", (0.2, 2.0), "command.params is out of reach"),
        ("nero_lift", "events.reset_object_position.params.x", (-1.5, 0.0), "events.reset_object_position.params is out"),
        ("nero_clutter", "robot.base_pos", (0.0, 0.0, 3.0), "events.scatter.params is out of reach"),
    ],
)
def test_a_region_beyond_it_is_told(env, field, value, where):
    with pytest.warns(UserWarning, match=where):
        make(env, impl="native", **{field: value})


def test_the_second_arm_reaches_for_itself():
    """A handover's goals are the taker's."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        make("nero_handover", impl="native")


def test_a_program_says_it_in_one_line(call):
    """Before it finds that the task has no such controller, as this costs no compilation."""
    code, _, err = call("eval", "--env", "nero_reach", "--agent", "ik", "--env.command.params.x", "(1.4,1.5)")
    warned, failed = err.splitlines()
    assert code == 2 and warned.startswith("warning: command.params is out of reach: no hand comes nearer than 0.")
    assert failed.startswith("error: 'ik' cannot play nero_reach")
