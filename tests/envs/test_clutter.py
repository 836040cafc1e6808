"""Clutter: which objects come, which is commanded, what counts as lifted; and the controller that does it."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjx_nero import UserError, env_cfg, make
from mjx_nero.mdp import metrics, rewards
from mjx_nero.mdp.terms import MetricTerm, RewardTerm
from mjx_nero.runs import evaluation
from mjx_nero.sim import contacts, scene
from mjx_nero.sim.scene import ObjectCfg
from mjx_nero.tasks import clutter

NAMES = ("box", "bar", "cylinder", "sphere", "capsule", "pill")
CFG = env_cfg("nero_clutter")
HELD = CFG.metrics["grasped"].params
HAND = {"nero": (0.006, 0.023), "cobotta_pro_900": (0.008, 0.025), "so_arm100": (0.004, 0.012)}  # pads: thickness, width [m]


@pytest.fixture(scope="module")
def env():
    return make("nero_clutter", impl="native", num_envs=8)


@pytest.fixture(scope="module")
def starts(env):
    """200 starts."""
    return jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 200))


def poses(env, state, name) -> np.ndarray:
    at = env.physics_model.joint(name).qposadr[0]
    return np.asarray(state.pipeline_state.qpos[..., at : at + 7])


@pytest.mark.parametrize("robot", HAND)
def test_an_open_hand_goes_round_every_object_and_touches_no_other(robot):
    """Wherever the objects lie: by circles around them, the largest that are drawn."""
    cfg = env_cfg("clutter", robot=robot)
    place, (thickness, width) = cfg.events["scatter"].params, HAND[robot]
    # Outlines from above: a box's half diagonal, a lying capsule's half length.
    objects = cfg.scene.objects
    around = {
        "box": np.hypot(*objects["box"].size[:2]) / 2,
        "bar": np.hypot(*objects["bar"].size[:2]) / 2,
        "cylinder": objects["cylinder"].size[0],
        "sphere": objects["sphere"].size[0],
        **{name: objects[name].size[0] + objects[name].size[1] / 2 for name in ("capsule", "pill")},
    }
    most = 1.15 * max(around.values())
    gap = float(cfg.robot.gripper.gap(jnp.array(cfg.robot.gripper.open)))
    widest = 1.15 * objects["box"].size[0]
    assert widest < gap <= 1.52 * widest and cfg.robot.gripper.home == cfg.robot.gripper.open
    assert 2 * most < place["pitch"] - 2 * place["jitter"]
    assert np.hypot(gap / 2 + thickness, width / 2) + most < place["pitch"] - 2 * place["jitter"]


def test_sizes_and_masses_differ_and_objects_rest_on_the_table(env, starts):
    model, fields = env.physics_model, {name: np.asarray(x) for name, x in starts.pipeline_state.fields.items()}
    for name in NAMES:
        geom, body = model.geom(name).id, model.body(name).id
        factor = fields["geom_size"][:, geom, 0] / model.geom_size[geom, 0]
        assert 0.75 <= factor.min() < 0.8 and 1.1 < factor.max() <= 1.15
        heavier = fields["body_mass"][:, body] / model.body_mass[body]
        assert 0.5 <= heavier.min() < 0.6 and 1.8 < heavier.max() <= 2.0
        np.testing.assert_allclose(
            fields["body_inertia"][:, body] / model.body_inertia[body], (heavier * factor**2)[:, None] * np.ones(3), rtol=1e-4
        )
        np.testing.assert_allclose(fields["body_invweight0"][:, body, 0], 1 / fields["body_mass"][:, body], rtol=1e-4)
        rest = {"box": 0.5, "bar": 0.3, "cylinder": 0.55, "sphere": 0.45, "capsule": 0.33, "pill": 0.42}[name] * 0.04 / 1.15
        np.testing.assert_allclose(poses(env, starts, name)[:, 2], factor * rest, atol=1e-4)
    assert clutter.volume(ObjectCfg(shape="cylinder", size=(0.1, 0.2))) == pytest.approx(0.0062832, rel=1e-4)
    assert clutter.volume(ObjectCfg(shape="capsule", size=(0.1, 0.2))) == pytest.approx(0.0062832 + 0.0041888, rel=1e-4)
    assert clutter.volume(ObjectCfg(shape="sphere", size=(0.1,))) == pytest.approx(0.0041888, rel=1e-4)


def test_the_commanded_one_is_what_the_terms_call_target(env, starts):
    target = np.asarray(starts.info["carry"].memory["target"])
    assert set(target) == set(range(6))
    view = jax.jit(jax.vmap(env.view))(starts)
    where = np.stack([poses(env, starts, name) for name in NAMES], axis=1)[np.arange(200), target]
    np.testing.assert_array_equal(view.objects["target"].pos_w, where[:, :3])
    np.testing.assert_array_equal(view.objects["target"].quat_w, where[:, 3:])
    seen = jax.jit(jax.vmap(env.named_observations))(starts)["state"]
    np.testing.assert_allclose(seen["object_to_goal"], np.asarray(view.goal_pos_w) - where[:, :3], atol=1e-6)
    assert (where[:, 0] >= 0.3 - 1e-6).all() and (where[:, 0] <= 0.4 + 1e-6).all()


def test_it_stays_the_same_through_an_episode_and_changes_with_the_next(env):
    step = jax.jit(jax.vmap(env.step_and_reset))
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(1), 8))
    targets = [np.asarray(state.info["carry"].memory["target"])]
    last = state.info["carry"].replace(step=jnp.full(8, env.episode_length - 3))
    state = state.replace(info={**state.info, "carry": last})
    for _ in range(3):
        state = step(state, jnp.zeros((8, env.action_size)))
        targets.append(np.asarray(state.info["carry"].memory["target"]))
    np.testing.assert_array_equal(targets[0], targets[2])
    assert state.done.all() and (targets[3] != targets[0]).any()


def test_what_counts_as_held_is_above_the_largest_of_its_kind(env, starts):
    """By 5 mm: no object counts as held while it lies, whichever is commanded, and each has a height of its own."""
    heights = CFG.rewards["holding_object"].params["minimal_height"]
    for name, height in zip(NAMES, heights, strict=True):
        lies = poses(env, starts, name)[:, 2].max()
        assert lies < height - 0.004 and height < 1.15 * CFG.scene.objects[name].rest_height + 0.0051
    paid = jax.jit(jax.vmap(lambda view: rewards.object_is_held(view, **CFG.rewards["holding_object"].params)))
    view = jax.jit(jax.vmap(env.view))(starts)
    at = view.replace(ee_pos_w=view.objects["target"].pos_w)
    assert float(paid(at).sum()) == 0
    up = dataclasses.replace(view.objects["target"], pos_w=view.objects["target"].pos_w + jnp.array([0.0, 0.0, 0.02]))
    raised = view.replace(objects={**view.objects, "target": up}, ee_pos_w=up.pos_w)
    assert float(paid(raised).mean()) == 1


def test_a_picture_shows_what_was_drawn_and_the_commanded_one_in_green(env, starts):
    looks = jax.jit(jax.vmap(env.scenery))(starts).objects
    target = np.asarray(starts.info["carry"].memory["target"])
    for i, name in enumerate(NAMES):
        size, rgba = np.asarray(looks[name].size), np.asarray(looks[name].rgba)
        np.testing.assert_array_equal(size, starts.pipeline_state.fields["geom_size"][:, env.physics_model.geom(name).id])
        green = np.abs(rgba - [0.2, 0.8, 0.3, 1.0]).max(axis=1) < 1e-6
        np.testing.assert_array_equal(green, target == i)
    lift = make("nero_lift", impl="native")
    shown = jax.eval_shape(lambda key: lift.scenery(lift.reset(key)), jax.random.PRNGKey(0))
    assert shown.objects == {}  # as it was: nothing differs


def test_all_shapes_lie_still_in_the_c_library():
    """Five seconds on the table at the task's own step, and a push of 10 cm/s after which none rolls on for long."""
    model = scene.build(CFG.robot, CFG.scene, CFG.sim, visuals=False, fuse=True)
    data = mujoco.MjData(model)
    for joint, position in zip(CFG.robot.joints, CFG.robot.home, strict=True):
        data.joint(joint).qpos[0] = data.actuator(joint).ctrl[0] = position
    for i, name in enumerate(NAMES):
        data.joint(name).qpos[:2] = 0.3 + 0.1 * (i % 3), -0.1 + 0.2 * (i // 3)
    mujoco.mj_step(model, data, 50)  # they sink in by a fraction of a millimetre
    settled = data.qpos.copy()
    mujoco.mj_step(model, data, 500)
    objects = [slice(at, at + 3) for at in (model.joint(name).qposadr[0] for name in NAMES)]
    assert max(np.abs(data.qpos[at] - settled[at]).max() for at in objects) < 1e-6
    for name in NAMES:
        data.joint(name).qvel[0] = 0.1
    mujoco.mj_step(model, data, 500)
    assert max(np.abs(data.qpos[at] - settled[at]).max() for at in objects) < 0.02
    assert max(np.abs(data.joint(name).qvel).max() for name in NAMES) < 1e-4


def test_buffers_are_counted_from_the_model():
    model = scene.build(CFG.robot, CFG.scene, CFG.sim, visuals=False)
    every = contacts.contact_pairs(model)
    least = sum(pair.contacts for pair in every if pair.first == "table" and pair.second in NAMES)
    assert least == 4 + 4 + 4 + 1 + 2 + 2  # what lies on the table
    assert least + 16 <= CFG.sim.contacts_per_env <= sum(pair.contacts for pair in every)
    assert CFG.sim.constraints_per_env <= sum(contacts.constraint_rows(model).values())


def test_all_backends_know_all_pairs_of_shapes_but_a_plain_cylinders():
    """MJX-JAX refuses that in one line; MJX-Warp and the C library have their general routines for it."""
    env = make("nero_clutter", impl="jax")
    env.physics  # noqa: B018
    pairs = {tuple(sorted(pair.shapes.split(", "))) for pair in contacts.contact_pairs(env.physics_model)}
    assert ("box", "cylinder") not in pairs and {("cylinder", "plane"), ("box", "capsule"), ("box", "box")} <= pairs
    with pytest.raises(UserError, match="^MJX-JAX cannot compute this scene: .*CYLINDER"):
        make("nero_clutter", impl="jax", **{"scene.objects.cylinder.shape": "cylinder"}).physics  # noqa: B018


def test_four_objects_are_one_of_each_shape_and_the_lighter_for_it():
    cfg = env_cfg("nero_clutter", "four")
    assert cfg.command.targets == tuple(cfg.scene.objects) == ("box", "cylinder", "sphere", "capsule")
    assert cfg.events["scatter"].params["count"] == (3, 4) and CFG.events["scatter"].params["count"] == (3, 6)
    assert {name: item for name, item in CFG.scene.objects.items() if name in cfg.command.targets} == cfg.scene.objects
    assert cfg.sim.constraints_per_env < CFG.sim.constraints_per_env and cfg.robot == CFG.robot


def near(term: str) -> dict:
    return {"rewards": {"near": RewardTerm(rewards.object_ee_distance, weight=1.0, params={"std": 0.1, "object": term})}}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (near("bal"), "^rewards.near.params.object is 'bal', but the scene's objects are: box, .*, pill, target$"),
        (
            {"command": dataclasses.replace(CFG.command, targets=("box", "ball"))},
            "^command.targets names ball: not one of box, bar, cylinder, sphere, capsule, pill$",
        ),
        (
            {"metrics": {"grasped": MetricTerm(metrics.Grasped, params={**HELD, "minimal_height": (0.02, 0.03)})}},
            "^metrics.grasped.params.minimal_height is one height, or one for each of 6 targets$",
        ),
        ({"scene": dataclasses.replace(CFG.scene, objects={**CFG.scene.objects, "target": ObjectCfg()})}, "needs another name"),
    ],
)
def test_names_that_are_not_there(changes, message):
    with pytest.raises(UserError, match=message):
        dataclasses.replace(CFG, **changes)


def test_without_targets_no_term_may_name_one():
    with pytest.raises(UserError, match="^rewards.near.params.object is 'target', but the scene's objects are: cube$"):
        dataclasses.replace(env_cfg("nero_lift"), **near("target"))


@pytest.mark.slow
@pytest.mark.parametrize(("name", "preset"), [("cobotta_clutter", "default"), ("nero_clutter", "four")])
def test_the_controller_lifts_what_it_is_told_to(name, preset):
    expert = evaluation.play(evaluation.EvalCfg(name, preset=preset, controller="expert", episodes=32, impl="native")).result
    assert expert["success_rate"] >= 28 / 32 and expert["nan_count"] == 0
    for agent in ("zero", "random") if preset == "four" else ():
        idle = evaluation.play(evaluation.EvalCfg(name, preset=preset, agent=agent, episodes=32, impl="native")).result
        assert idle["success_rate"] == 0 and expert["return_mean"] > idle["return_mean"] + 50
