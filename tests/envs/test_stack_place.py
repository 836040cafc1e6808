"""Stacking and placing: configs for any robot, towers that rest, the expert, and what it is paid."""

import dataclasses
import functools
import itertools
import math

import jax
import mujoco
import numpy as np
import pytest

from mjx_nero import UserError, env_cfg, make
from mjx_nero.control.pick_place import PickPlaceCfg
from mjx_nero.mdp import towers
from mjx_nero.runs import evaluation
from mjx_nero.sim import contacts, scene
from mjx_nero.sim.robot import GripperCfg
from mjx_nero.tasks import place, stack
from mjx_nero.tasks.arms.nero import NERO

ROBOTS = ("nero", "cobotta_pro_900", "piper", "so_arm100", "so_arm101")


@pytest.mark.parametrize("robot", ROBOTS)
def test_every_arm_stacks_cubes_of_its_own_size(robot):
    cfg = env_cfg("stack", robot=robot)
    blue, red = cfg.scene.objects["blue"], cfg.scene.objects["red"]
    edge, opening = red.size[0], cfg.robot.opening
    assert blue.size == red.size == (edge,) * 3 and 0.3 * opening < edge <= 0.6 * opening
    start = cfg.events["reset_object_positions"].params
    (x, y), apart = (start["x"], start["y"]), start["apart"]
    assert start["objects"] == ("blue", "red") and (x, y) == cfg.robot.pick[:2]  # these arms stand at the world's origin
    assert apart > (opening + edge) / 2 + 0.02  # an open hand about one does not meet the other
    assert max(np.ptp(x), np.ptp(y)) > apart
    fields = dict(cfg.controllers["pick_place"])
    assert fields["tower"] == ("blue", "red") and fields["rise"] == edge
    above = cfg.robot.pick[2][0] + edge + cfg.success.condition.params["place"].clearance
    assert fields["end_effector_initial_height"] > above  # or the hand never counts as away
    assert cfg.robot.gravity_compensation


def test_the_packages_environments_are_those_for_any_robot():
    for own, robot in (("nero", "nero"), ("cobotta", "cobotta_pro_900")):
        for task in ("stack", "place"):
            assert env_cfg(f"{own}_{task}") == env_cfg(task, robot=robot)


def test_place_is_of_a_box_that_shows_how_it_is_turned():
    cfg = env_cfg("nero_place")
    assert cfg.scene.objects["box"].size == (0.06, 0.04, 0.04) and cfg.scene.goal == "box"
    assert cfg.scene.objects["box"].mass == pytest.approx(0.096)  # as dense as water
    for name in ("x", "y"):
        assert cfg.command.params[name] == cfg.events["reset_object_position"].params[name]
    assert cfg.command.params["z"] == (0.02, 0.02)
    assert cfg.command.params["yaw"] == cfg.events["reset_object_yaw"].params["yaw"] == pytest.approx((-np.pi / 6, np.pi / 6))
    assert cfg.controllers["pick_place"]["turn"] and "aligning" in cfg.rewards
    raised = env_cfg("place", robot=dataclasses.replace(NERO, base_pos=(0.0, 0.0, 0.1)))
    assert raised.command.params["z"] == pytest.approx((-0.08, -0.08))  # of the robot's frame


def test_a_box_that_is_to_be_placed_does_not_lie_there_already():
    env = make("nero_place", impl="native")
    view = jax.vmap(env.view)(jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 500)))
    away = np.linalg.norm((view.goal_pos_w - view.objects["box"].pos_w)[:, :2], axis=1)
    assert away.min() > 0.08 and (away >= 0.1 - 1e-6).mean() > 0.99  # two and a half of its heights; the farthest, should none be


def test_an_arm_of_four_joints_places_a_cube_without_a_turn():
    short = dataclasses.replace(NERO.arm, **{f.name: getattr(NERO.arm, f.name)[:4] for f in dataclasses.fields(NERO.arm)})
    cfg = place.default(dataclasses.replace(NERO, arm=short))
    assert cfg.scene.objects["box"].size == (0.04,) * 3 and cfg.command.params["yaw"] == (0.0, 0.0)
    assert "aligning" not in cfg.rewards and cfg.controllers["pick_place"]["ik.free_turn"]
    assert not cfg.controllers["pick_place"]["turn"]


def test_fingers_close_in_half_a_second_at_the_least():
    assert env_cfg("nero_stack").robot.gripper.speed == pytest.approx((0.1, 0.098))  # 50 and 49 mm
    assert env_cfg("cobotta_stack").robot.gripper.speed == (0.9, 0.9)  # its own


def test_fingers_have_let_go_from_where_they_hold_a_cube_and_are_told_to_from_shut():
    rewards = {env: env_cfg(env).rewards for env in ("nero_stack", "cobotta_stack", "nero_place")}
    assert rewards["nero_stack"]["leaving"].params["hold"] == pytest.approx((0.02, -0.02))  # a cube of 4 cm
    assert rewards["cobotta_stack"]["leaving"].params["hold"] == pytest.approx((0.242, -0.242), abs=1e-3)
    assert rewards["nero_place"]["leaving"].func is towers.left
    for env, terms in rewards.items():
        assert terms["releasing"].params["hold"] == env_cfg(env).robot.gripper.close


@pytest.mark.parametrize("name", ["nero_place", "cobotta_place", "nero_stack", "cobotta_stack"])
def test_fingers_that_press_turn_back_before_their_speed_is_limited(name):
    assert list(env_cfg(name).actions)[-2:] == ["anti_windup", "speed_limit"]


@pytest.mark.parametrize("name", ["nero_stack", "cobotta_stack"])
def test_a_cube_that_leans_on_its_edge_is_not_held(name):
    cfg = env_cfg(name)
    edge = cfg.scene.objects["red"].size[0]
    assert cfg.rewards["holding_object"].params["place"].minimal_height > edge / math.sqrt(2)
    assert cfg.metrics["grasped"].params["minimal_height"] == pytest.approx(0.75 * edge)
    assert cfg.rewards["approaching"].params["flat"] == edge / 2  # as far as it counts as over its place


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_box_that_is_only_tipped_over_an_edge_is_not_held(robot):
    cfg = env_cfg("place", robot=robot)
    long, _, high = cfg.scene.objects["box"].size
    angles = np.radians(np.arange(91))  # until it stands on its end
    highest = max(np.sin(angles) * long / 2 + np.cos(angles) * high / 2)
    heights = [cfg.rewards[name].params["place"].minimal_height for name in ("holding_object", "approaching")]
    for height in (*heights, cfg.metrics["grasped"].params["minimal_height"]):
        assert highest < height < highest + 0.004
    assert cfg.rewards["approaching"].params["flat"] == 0.02  # as far as it counts as over its place


def test_robots_that_cannot_are_told_in_one_line():
    low = dataclasses.replace(NERO, pick=((0.3, 0.4), (-0.1, 0.2), (0.02, 0.08)))
    assert stack.default(low).controllers["pick_place"]["end_effector_initial_height"] == pytest.approx(
        0.06 + 0.055
    )  # above pick
    with pytest.raises(UserError, match="^nero cannot build a tower that high: its hand has to point down 0.11 m above its root"):
        stack.three(low)
    with pytest.raises(UserError, match="^nero has no gripper: this task needs one"):
        stack.default(dataclasses.replace(NERO, gripper=GripperCfg()))


@pytest.mark.parametrize(("env", "preset"), [("nero_stack", "default"), ("cobotta_stack", "three"), ("nero_place", "default")])
def test_buffers_hold_the_worst_case(env, preset):
    cfg = env_cfg(env, preset)
    model = scene.build(cfg.robot, cfg.scene, cfg.sim, visuals=False)
    assert cfg.sim.contacts_per_env == sum(pair.contacts for pair in contacts.contact_pairs(model))
    assert cfg.sim.constraints_per_env == sum(contacts.constraint_rows(model).values())
    objects = list(cfg.scene.objects)
    meet = {frozenset((pair.first, pair.second)): pair.contacts for pair in contacts.contact_pairs(model)}
    assert all(meet[frozenset(pair)] == 8 for pair in itertools.combinations(objects, 2))


def rest(env: str, preset: str, offset: float) -> np.ndarray:
    """Where a tower's cubes are, each ``offset`` of an edge beside the one below, every 10 ms for five seconds, in edges."""
    cfg = env_cfg(env, preset)
    model = scene.build(cfg.robot, cfg.scene, cfg.sim, visuals=False)
    data, edge = mujoco.MjData(model), cfg.scene.objects["blue"].size[0]
    for joint, home in zip(cfg.robot.joints, cfg.robot.home, strict=True):
        data.joint(joint).qpos[0] = home
    data.ctrl[:] = cfg.robot.home
    names = list(cfg.scene.objects)
    for i, name in enumerate(names):
        data.joint(name).qpos[:3] = [0.35 + i * offset * edge, 0.1, (i + 0.5) * edge]
    at = []
    for _ in range(500):
        mujoco.mj_step(model, data)
        at.append([data.body(name).xpos.copy() for name in names])
    return np.array(at) / edge


@pytest.mark.parametrize("env", ["nero_stack", "cobotta_stack"])
def test_three_cubes_rest_on_one_another_without_creeping(env):
    at = rest(env, "three", 0.2)
    np.testing.assert_allclose(at[-1, :, 2], [0.5, 1.5, 2.5], atol=0.03)  # contacts give way by a little
    edge = env_cfg(env).scene.objects["blue"].size[0]
    assert edge * np.abs(at[-1] - at[100]).max() < 4 * 5e-5  # [m] in four seconds


def test_a_cube_too_far_off_falls():
    assert rest("nero_stack", "default", 0.6)[-1, 1, 2] < 1.0


# --- the expert


@pytest.fixture(scope="module")
def play():
    """``play(env, who, hover) -> result`` of eight episodes; a hovering expert never comes down to the place."""

    @functools.cache
    def run(env: str, who: str, hover: bool = False) -> dict:
        shares = list(env_cfg(env).controllers["pick_place"]["events_dt"])
        shares[6] = 1e-3 if hover else shares[6]
        agent = {"controller": who, "control_fields": {"events_dt": tuple(shares)}} if who == "expert" else {"agent": who}
        return evaluation.play(evaluation.EvalCfg(env, episodes=8, backend="mujoco", **agent)).result

    return run


@pytest.mark.slow
@pytest.mark.parametrize("env", ["nero_stack", "cobotta_place"])
def test_the_expert_does_it(play, env):
    result = play(env, "expert")
    assert result["controller"] == "pick_place" and result["warning"] == ""
    assert result["success_rate"] == 1 and result["grasp_rate"] == 1 and result["dropped_rate"] == 0
    assert result["final_distance_mean"] < 5e-3 and result["nan_count"] == 0


@pytest.mark.slow
def test_the_expert_stacks_with_a_small_arm():
    """Its hand points down no higher than 10 cm: over the tower it leans, and so does the PiPER's (``every_expert.py``)."""
    cfg = evaluation.EvalCfg("stack", robot="so_arm100", controller="expert", episodes=8, backend="mujoco")
    result = evaluation.play(cfg).result
    assert result["success_rate"] * 8 >= 6 and result["nan_count"] == 0


@pytest.mark.slow
def test_the_expert_is_paid_more_than_who_hovers_and_far_more_than_who_knows_nothing(play):
    expert, hover, zero, random = (play("nero_stack", *who) for who in (("expert",), ("expert", True), ("zero",), ("random",)))
    assert hover["success_rate"] == zero["success_rate"] == random["success_rate"] == 0 and hover["grasp_rate"] == 1
    assert expert["return_mean"] > 1.2 * hover["return_mean"]
    assert hover["return_mean"] > 5 * max(zero["return_mean"], random["return_mean"])


def test_the_controllers_defaults_are_the_tutorials_task():
    assert PickPlaceCfg().tower == ("goal", "cube") and PickPlaceCfg().rise == 0 and not PickPlaceCfg().turn
