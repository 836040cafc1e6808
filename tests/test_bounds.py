"""Bounds of every field, checked in one place, and configs that nobody can change."""

import functools
import math
import re
import typing

import pytest

from mjx_nero import UserError, env_cfg, make
from mjx_nero.config import bounds, docs
from mjx_nero.config.bounds import Bounds
from mjx_nero.envs.task import ThingCfg
from mjx_nero.mdp import commands, events, fixtures, looks, rewards
from mjx_nero.mdp.terms import RewardTerm, Term
from mjx_nero.sim.cameras import CameraCfg
from mjx_nero.sim.fixtures import FixtureCfg
from mjx_nero.sim.obstacles import ObstacleCfg
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.sim.scene import ObjectCfg, SceneCfg


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"scene.objects.cube.mass": -1.0}, "scene.objects.cube.mass must be above 0 and at most 1000, got -1.0"),
        ({"scene.objects.cube.mass": math.nan}, "scene.objects.cube.mass takes a finite number, got nan"),
        ({"scene.objects.cube.size": (0.03, 0.0, 0.03)}, "scene.objects.cube.size\\[1\\] must be above 0 and at most 2, got 0.0"),
        ({"scene.objects.cube.friction": (1.0, -0.1, 0.0)}, "scene.objects.cube.friction\\[1\\] must be at least 0, got -0.1"),
        ({"scene.objects.cube.size": (5.0,) * 3}, "scene.objects.cube.size\\[0\\] must be above 0 and at most 2, got 5.0"),
        ({"scene.objects.cube.mass": 1e9}, "scene.objects.cube.mass must be above 0 and at most 1000, got 1000000000.0"),
        ({"robot.base_pos": (0.0, 0.0, 900.0)}, "robot.base_pos\\[2\\] must be at least -20 and at most 20, got 900.0"),
        ({"command.params.x": (0.3, 60.0)}, "command.params.x\\[1\\] must be at least -20 and at most 20, got 60.0"),
        ({"sim.dt": 0}, "sim.dt must be at least 1e-06 and at most 1, got 0"),
        ({"sim.dt": -0.01}, "sim.dt must be at least 1e-06 and at most 1, got -0.01"),
        ({"sim.decimation": 0}, "sim.decimation must be at least 1 and at most 10000, got 0"),
        ({"episode_length_s": 0}, "episode_length_s must be above 0, got 0"),
        ({"episode_length_s": math.inf}, "episode_length_s takes a finite number, got inf"),
        ({"command.params.x": (0.6, 0.3)}, r"command.params.x is a range and must run from low to high, got \(0.6, 0.3\)"),
        ({"events.reset_object_position.params.y": (0.1, -0.1)}, "events.reset_object_position.params.y is a range and must run"),
        ({"rewards.reaching_object.params.std": 0.0}, "rewards.reaching_object.params.std must be above 0, got 0.0"),
        ({"rewards.reaching_object.weight": math.nan}, "rewards.reaching_object.weight takes a finite number, got nan"),
        (
            {"observations.state.terms.joint_pos.noise": -0.1},
            ".*state.terms.joint_pos.noise must be at least 0, got -0.1",
        ),
        (
            {"observations.state.terms.joint_pos.delay": (2, 1)},
            ".*state.terms.joint_pos.delay is a range and must run",
        ),
        (
            {"observations.state.terms.joint_pos.delay": (-1, 1)},
            r".*delay\[0\] must be at least 0 and at most 256, got -1",
        ),
        (
            {"observations.state.terms.joint_pos.delay": (0, 50_000_000)},
            r".*joint_pos.delay\[1\] must be at least 0 and at most 256, got",
        ),
        ({"observations.state.terms.joint_pos.history": 10**9}, ".*joint_pos.history must be at least 1 and at most 256"),
        ({"sim.dt": 1e-12}, "sim.dt must be at least 1e-06 and at most 1, got 1e-12"),
        ({"sim.contacts_per_env": 10**9}, "sim.contacts_per_env must be at least 1 and at most 100000, got 1000000000"),
        (
            {"observations.state.terms.joint_pos.hold": 1.5},
            "observations.state.terms.joint_pos.hold must be at least 0 and at most 1, got 1.5",
        ),
        ({"robot.arm.stiffness": (0.0,) * 7}, "robot.arm.stiffness\\[0\\] must be above 0, got 0.0"),
        ({"command.resample_s": 0.0}, "command.resample_s must be above 0, got 0.0"),
        ({"action_clip": -1.0}, "action_clip must be at least 0, got -1.0"),
    ],
)
def test_values_beyond_their_bounds_are_refused_by_name(changes, message):
    with pytest.raises(UserError, match=f"^{message}"):
        env_cfg("nero_lift", **changes)


def test_an_episode_shorter_than_a_step_is_refused():
    with pytest.raises(UserError, match=r"episode_length_s must be a control step \(0.02 s\) or more, got 0.001"):
        make("nero_lift", impl="native", episode_length_s=0.001)


def test_a_bad_value_ends_a_command_in_one_line(call):
    code, _, err = call("train", "--env", "nero_lift", "--env.scene.objects.cube.mass", "-1")
    assert code == 2 and err == "error: scene.objects.cube.mass must be above 0 and at most 1000, got '-1'\n"


def test_configs_are_read_only_all_the_way_down():
    cfg = env_cfg("nero_reach", "isaac")
    for mapping in (cfg.training, cfg.rewards, cfg.observations["state"].terms, cfg.scene.objects, cfg.actions["arm"].params):
        with pytest.raises(TypeError, match="does not support item assignment"):
            mapping["num_epochs"] = 99
    assert env_cfg("cobotta_reach", "isaac").training["num_epochs"] == 8


def test_a_config_keeps_no_mapping_of_its_makers():
    params = {"std": 0.1}
    term = RewardTerm(rewards.object_ee_distance, weight=1.0, params=params)
    params["std"] = 0.5
    assert term.params["std"] == 0.1


def test_parameters_with_defaults_may_be_left_out_or_overridden():
    def term(view, *, near: float, far: float = 2.0):
        return near + far

    assert Term(term, params={"near": 1.0})(None) == 3.0
    assert Term(term, params={"near": 1.0, "far": 5.0})(None) == 6.0
    with pytest.raises(UserError, match="^term takes the parameters near, far; given: far$"):
        Term(term, params={"far": 1.0})


def test_a_partial_is_a_term():
    part = functools.partial(rewards.object_ee_distance, std=0.1)
    assert Term(part).params == {"std": 0.1, "object": "cube"}
    with pytest.raises(UserError, match="^object_ee_distance takes the parameters std, object; given: sdt$"):
        Term(part, params={"sdt": 1.0})
    changes = {"rewards": {"near": RewardTerm(part, weight=1.0)}, "curriculum": {}}
    cfg = env_cfg("nero_lift", **changes, **{"rewards.near.params.std": 0.3})
    assert cfg.rewards["near"].params["std"] == 0.3


def test_a_robot_given_as_a_preset_is_told_so():
    with pytest.raises(UserError, match="^'piper' is a robot, not a preset of nero_lift: pass it as --robot$"):
        env_cfg("nero_lift", "piper")


def limited(kind) -> bool:
    """Whether every number of a type has a greatest value."""
    if typing.get_origin(kind) is typing.Annotated:
        inner, *marks = typing.get_args(kind)
        return any(isinstance(mark, Bounds) and mark.high < math.inf for mark in marks) or limited(inner)
    if kind in (int, float):
        return False
    return all(limited(inner) for inner in typing.get_args(kind) if inner is not type(None))


@pytest.mark.parametrize("cls", [RobotCfg, ObjectCfg, ObstacleCfg, FixtureCfg, CameraCfg, SceneCfg, ThingCfg])
def test_lengths_and_masses_have_a_greatest_value(cls):
    hints = typing.get_type_hints(cls, include_extras=True)
    measured = [name for name, text in docs.fields(cls).items() if re.search(r"\[(m|kg|kg/m3)\]", text) and name != "friction"]
    assert measured and [name for name in measured if not limited(hints[name])] == []


@pytest.mark.parametrize("module", [commands, events, fixtures, looks])
def test_places_of_terms_have_a_greatest_value(module):
    terms = {name: term for name, term in vars(module).items() if callable(term) and term.__module__ == module.__name__}
    found = {
        f"{name}.{axis}": hint
        for name, term in terms.items()
        for axis, hint in bounds.parameter_hints(term).items()
        if axis in ("x", "y", "z")
    }
    assert found and [name for name, hint in found.items() if not limited(hint)] == []
