"""Two robots in one scene, and the handover: names, views, errors of one line, who holds the bar, and that the script does it."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjx_nero import UserError, env_cfg, make
from mjx_nero.control.hand_over import HandOver
from mjx_nero.mdp import handover, observations, success
from mjx_nero.mdp.terms import MetricTerm, ObservationTerm
from mjx_nero.runs import evaluation
from mjx_nero.sim import kinematics, scene, team
from mjx_nero.sim.scene import SceneCfg, SimCfg
from mjx_nero.tasks import registry
from mjx_nero.tools.demos import making
from mjx_nero.tools.inspection import report

NERO, COBOTTA = registry.robot("nero"), registry.robot("cobotta_pro_900")


def beside(robot, x=1.0):
    return dataclasses.replace(robot, base_pos=(x, 0.0, 0.0))


@pytest.fixture(scope="module")
def env():
    return make("nero_handover", impl="native", num_envs=2)


@pytest.fixture(scope="module")
def state(env):
    return jax.jit(env.reset)(jax.random.PRNGKey(0))


@pytest.mark.parametrize("other, couplings", [(NERO, 0), (COBOTTA, 5)])
def test_another_robot_keeps_its_names_behind_its_own(other, couplings):
    alone = scene.build(NERO, SceneCfg(), SimCfg(), visuals=False)
    model = scene.build(NERO, SceneCfg(robots={"taker": beside(other)}), SimCfg(), visuals=False, fuse=True)
    drives = [model.actuator(i).name for i in range(model.nu)]
    assert drives == [*NERO.joints, *(f"taker/{joint}" for joint in other.joints)]
    assert model.neq == alone.neq + couplings
    data = mujoco.MjData(model)
    for joint, at in zip(other.joints, other.home, strict=True):
        data.joint(f"taker/{joint}").qpos = at
    mujoco.mj_kinematics(model, data)
    single = scene.robot_model(other)
    there = kinematics.Chain(single, other.joints, [other.ee_site]).poses(jnp.array(other.home))[0][0]
    if not couplings:
        np.testing.assert_allclose(data.site(f"taker/{other.ee_site}").xpos, np.asarray(there) + [1, 0, 0], atol=1e-5)


def test_the_scene_of_one_robot_has_no_others():
    cfg = env_cfg("nero_lift")
    assert team.of(cfg.robot, cfg.scene.robots) == {"": cfg.robot}
    assert list(team.drives({"": NERO})) == ["arm", "gripper"] and team.joints({"": NERO}) == NERO.joints


@pytest.mark.parametrize(
    "robots, text",
    [
        ({"cube": beside(NERO)}, "scene.robots.cube needs another name"),
        ({"a/b": beside(NERO)}, "'a/b' is not a name"),
        ({"taker": beside(NERO, 0.1)}, "the first robot and taker stand 0.1 m from one another"),
        ({"a": beside(NERO), "b": beside(COBOTTA, 1.05)}, "a and b stand 0.05 m from one another"),
    ],
)
def test_names_and_places_are_checked(robots, text):
    with pytest.raises(UserError, match=text):
        scene.build(NERO, SceneCfg(robots=robots), SimCfg())


def test_a_term_names_a_robot_that_is_there():
    cfg = env_cfg("nero_handover")
    with pytest.raises(UserError, match=r"to_goal.params.robot is 'tacker', but the scene's further robots are: taker"):
        dataclasses.replace(cfg, metrics={"to_goal": MetricTerm(success.ee_distance, params={"robot": "tacker"})})
    with pytest.raises(UserError, match="events.reset_object_yaw.params.robot has no effect"):
        event = cfg.events["reset_object_yaw"]
        event = dataclasses.replace(event, params={**event.params, "robot": "taker"})
        dataclasses.replace(cfg, events={**cfg.events, "reset_object_yaw": event})
    with pytest.raises(UserError, match="is 'tacker/arm', and the drives' groups are: arm, gripper, taker/arm, taker/gripper"):
        make("nero_handover", impl="native", **{"actions.taker_arm.params.group": "tacker/arm"})
    with pytest.raises(UserError, match="hand_over: taker is 'taker', but the scene's further robots are: none"):
        HandOver(NERO, 0.02)
    with pytest.raises(UserError, match="so_arm101 has 5 joints: to hand a bar over, an arm needs 6"):
        env_cfg("handover", robot="so_arm101")


def test_a_view_of_one_robot_is_as_if_it_were_alone(env, state):
    view = jax.jit(env.view)(state)
    first, second = view.of(), view.of("taker")
    np.testing.assert_array_equal(jnp.concatenate([first.joint_pos, second.joint_pos]), view.joint_pos)
    np.testing.assert_array_equal(jnp.concatenate([first.ctrl, second.ctrl]), view.ctrl)
    np.testing.assert_array_equal(first.ee_pos_w, view.ee_pos_w)
    np.testing.assert_allclose(second.root_pos_w + second.command, view.goal_pos_w, atol=1e-6)
    mate = env.cfg.scene.robots["taker"]
    chain = kinematics.Chain(scene.robot_model(mate), mate.joints, [mate.ee_site])
    np.testing.assert_allclose(second.ee_pos_w, chain.poses(second.joint_pos)[0][0], atol=1e-5)
    assert ObservationTerm(observations.ee_position, params={"robot": "taker"}).seen(view).robots == {}
    with pytest.raises(UserError, match="no robot is called 'x': the scene's are taker"):
        view.of("x")


def test_what_knows_one_robot_says_so(env):
    with pytest.raises(
        UserError, match="a data set of demonstrations supports only scenes of one robot, but this one also has taker"
    ):
        making.units_of(env, "si")


def test_inspect_lists_the_joints_of_both():
    found = report.inspect("nero_cobotta_handover")
    assert found.robot == "nero, cobotta_pro_900 as taker"
    groups = {joint.name: joint.group for joint in found.joints}
    assert groups["joint1"] == "arm" and groups["taker/joint_1"] == "taker/arm"
    assert groups["taker/finger_joint"] == "taker/gripper" and groups["taker/left_inner_finger_joint"] == ""


def test_bar_and_goal_are_out_of_the_others_reach():
    for name in ("nero_handover", "nero_cobotta_handover"):
        cfg = env_cfg(name)
        mate, bar = cfg.scene.robots["taker"], cfg.events["reset_object_position"].params
        reach = 0.75  # [m] farther than Nero's grasp point ever is from its base, along the table (0.741 in 40,000 postures)
        goal = cfg.command.params
        nearest = np.hypot(min(np.abs(goal["x"])), min(np.abs(goal["y"])))
        assert nearest - handover_half(cfg) > reach  # the giver's base is at the origin
        assert np.hypot(mate.base_pos[0] - max(bar["x"]), max(bar["y"])) - handover_half(cfg) > reach


def handover_half(cfg):
    return cfg.scene.objects["bar"].size[0] / 2


@pytest.fixture
def placed(env, state):
    """A function: where giver's hand, taker's hand and the bar's middle are, along x at a height -> the view."""
    hands = env.cfg.success.condition.params["hands"]

    def place(giver, taker, height=0.2):
        view = jax.jit(env.view)(state)
        bar = view.objects["bar"].replace(
            pos_w=jnp.array([0.4, 0.0, height]), quat_w=jnp.array([1.0, 0, 0, 0]), linvel_w=jnp.zeros(3)
        )
        one, two = (view.robots[name].replace(ee_pos_w=bar.pos_w + jnp.array(at)) for name, at in (("", giver), ("taker", taker)))
        return view.replace(
            objects={"bar": bar}, robots={"": one, "taker": two}, ee_pos_w=one.ee_pos_w, goal_pos_w=bar.pos_w + 0.01
        )

    return hands, place


AT, FAR = (-0.09, 0.0, 0.0), (-0.09, 0.0, 0.06)  # the giver's place on the bar, and 6 cm above it


def test_who_holds_the_bar(placed):
    hands, place = placed
    end = (0.09, 0.0, 0.01)
    both, alone, none = place(AT, end), place(FAR, end), place(FAR, (0.3, 0.0, 0.0))
    assert [bool(hands.gives(v)) for v in (both, alone, none)] == [True, False, False]
    assert [bool(hands.alone(v)) for v in (both, alone, none)] == [False, True, False]
    assert not hands.alone(place(FAR, end, height=0.03))  # it lies on the table
    np.testing.assert_allclose(hands.way(both, True), [0.0, 0.0, -0.01], atol=1e-6)
    assert float(hands.gap(alone, False)) == pytest.approx(0.06, abs=1e-6)
    assert float(hands.gap(place((-0.23, 0.0, 0.0), end), False)) == pytest.approx(0.1, abs=1e-6)  # beyond its end, at 0.13 m


def test_rewards_of_earlier_stages_stay(placed):
    hands, place = placed
    meet, end = (0.4, 0.0, 0.2), (0.09, 0.0, 0.0)
    both, alone = place(AT, end), place(FAR, end)
    assert float(handover.presented(both, hands=hands, meet=meet, std=0.1)) == pytest.approx(1.0)
    assert float(handover.met(both, hands=hands, std=0.05)) == pytest.approx(1.0)
    off = place(AT, (0.09, 0.0, 0.05))
    assert float(handover.met(off, hands=hands, std=0.05)) == pytest.approx(1 - np.tanh(1.0), abs=1e-5)
    between = place((-0.09, 0.0, 0.045), end)  # the giver's hand has let go, and has not left
    assert not hands.gives(between) and not hands.alone(between)
    closed = between.ctrl.at[-2:].set(jnp.array(hands.taking[1]))
    between = between.replace(ctrl=closed)
    assert hands.takes(between) and float(handover.presented(between, hands=hands, meet=meet, std=0.1)) == 1.0
    for value in (handover.reached(alone, hands=hands, std=0.1), handover.held(alone, hands=hands)):
        assert float(value) == 1.0
    assert float(handover.brought(both, hands=hands, std=0.1)) == 0.0
    far = np.sqrt(3) * 0.01
    assert float(handover.brought(alone, hands=hands, std=0.1)) == pytest.approx(1 - np.tanh(far / 0.1), abs=1e-5)


def test_success_needs_the_giver_first(placed):
    hands, place = placed
    done = handover.HeldAtGoal(hands=hands, threshold=0.03, max_speed=0.03)
    key, end = jax.random.PRNGKey(0), (0.09, 0.0, 0.0)
    both, alone = place(AT, end), place(FAR, end)
    memory = done.init(key, alone)
    memory, met = done.step(memory, alone)
    assert not met  # the taker took it from the table itself
    memory, met = done.step(memory, both)
    assert not met  # two hands hold it
    memory, met = done.step(memory, alone)
    assert met
    moving = alone.objects["bar"].replace(linvel_w=jnp.array([0.1, 0.0, 0.0]))
    assert not done.step(memory, alone.replace(objects={"bar": moving}))[1]
    assert handover.hands_clash(place(AT, (-0.02, 0.0, 0.0)), taker="taker", apart=0.09)
    assert not handover.hands_clash(both, taker="taker", apart=0.09)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["nero_handover", "nero_cobotta_handover"])
def test_the_script_does_it(name):
    """Over more episodes: docs/guides/two_arms.md. Few leave room for chance."""
    played = evaluation.play(evaluation.EvalCfg(name, controller="expert", episodes=8, backend="mujoco"))
    assert played.result["success_rate"] >= 0.8
