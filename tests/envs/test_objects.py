"""Scenes of several objects, groups of observations that stay apart, actions and observations that come late."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjx_nero import UserError, env_cfg, make
from mjx_nero.envs import wrappers
from mjx_nero.envs.task import joint_actions
from mjx_nero.learn import checkpoint
from mjx_nero.mdp import actions, events, observations, rewards
from mjx_nero.mdp.terms import ObservationGroup, ObservationTerm, RewardTerm, Term
from mjx_nero.sim.physics.mjx import JaxPhysics
from mjx_nero.sim.scene import ObjectCfg, SceneCfg, cube

CFG = env_cfg("nero_lift")
RED, BLUE = slice(9, 16), slice(16, 23)


@pytest.fixture(scope="module")
def two():
    """The lift task with a second cube, a reward for each, and a group of two observations that stay apart."""
    scene = SceneCfg(objects={"cube": cube(0.03, 0.03), "blue": ObjectCfg(pos=(0.2, 0.3, 0.0), mass=0.06)})
    image = ObservationTerm(lambda view: jnp.outer(view.action, view.joint_pos[:2]), noise=0.1)
    return make(
        "nero_lift",
        impl="native",
        scene=scene,
        rewards={
            "near_red": RewardTerm(rewards.object_ee_distance, weight=1.0, params={"std": 0.1}),
            "near_blue": RewardTerm(rewards.object_ee_distance, weight=1.0, params={"std": 0.1, "object": "blue"}),
        },
        observations={
            **CFG.observations,
            "parts": ObservationGroup(
                {"image": image, "blue": ObservationTerm(observations.object_position, params={"object": "blue"})}, apart=True
            ),
        },
    )


def test_every_object_is_seen_and_rewarded_by_its_name(two):
    state = jax.jit(two.reset)(jax.random.PRNGKey(0))
    model, qpos = two.physics_model, state.pipeline_state.qpos
    assert [model.joint(n).qposadr[0] for n in ("cube", "blue")] == [RED.start, BLUE.start] and model.nq == 23
    np.testing.assert_allclose(qpos[BLUE], [0.2, 0.3, 0.015, 1, 0, 0, 0], atol=1e-7)  # no event moves it
    view = jax.jit(two.view)(state)
    for name, at in (("cube", RED), ("blue", BLUE)):
        np.testing.assert_array_equal(view.objects[name].pos_w, qpos[at][:3])
        np.testing.assert_array_equal(view.objects[name].quat_w, qpos[at][3:])
    after = jax.jit(two.finish)(state, jnp.zeros(8), state.pipeline_state, jnp.zeros(()))
    for name, at in (("near_red", RED), ("near_blue", BLUE)):
        far = math.dist(view.ee_pos_w.tolist(), qpos[at][:3].tolist())
        assert float(after.metrics[f"reward/{name}"]) == pytest.approx(0.02 * (1 - math.tanh(far / 0.1)), rel=2e-3)


def collide(physics, sim, at, steps):
    """In the air a red cube of 30 g flies into a blue one of 60 g at 1 m/s: positions and speeds along x after every step."""
    red, blue = (jnp.array([x, 0.3, 1.0, 1, 0, 0, 0]) for x in (0.5, at))
    sim = sim.replace(qpos=sim.qpos.at[RED].set(red).at[BLUE].set(blue), qvel=sim.qvel.at[9].set(1.0))
    out = []
    for _ in range(steps):
        sim, _ = physics(sim, sim.ctrl)
        out.append([float(x) for x in (sim.qpos[9], sim.qpos[16], sim.qvel[9], sim.qvel[15])])
    return np.array(out)


def test_cubes_collide(two):
    start, step = jax.jit(two.sample)(jax.random.PRNGKey(0))[0], jax.jit(two.physics.step)
    red, blue, red_speed, blue_speed = collide(step, start, 0.55, 15).T
    np.testing.assert_allclose(0.03 * red_speed + 0.06 * blue_speed, 0.03, rtol=1e-3)  # momentum
    assert blue_speed[-1] > 0.3 and red_speed[-1] < 0.4 and (blue - red > 0.02).all()
    red, blue, red_speed, blue_speed = collide(step, start, 0.9, 15).T  # out of reach
    np.testing.assert_allclose([red_speed[-1], blue_speed[-1], blue[-1]], [1.0, 0.0, 0.9], atol=1e-3)


@pytest.mark.slow
def test_cubes_collide_alike_on_mjx(two):
    start = jax.jit(two.sample)(jax.random.PRNGKey(0))[0]
    step = jax.jit(JaxPhysics(two.physics_model, two.cfg.sim).step)
    np.testing.assert_allclose(collide(step, start, 0.55, 8), collide(jax.jit(two.physics.step), start, 0.55, 8), atol=5e-3)


@pytest.mark.parametrize(
    ("shape", "size", "quat", "height"),
    [
        ("box", (0.02, 0.04, 0.06), (1, 0, 0, 0), 0.03),
        ("box", (0.02, 0.04, 0.06), (0.5**0.5, 0.5**0.5, 0, 0), 0.02),  # a quarter turn about x
        ("sphere", (0.02,), (0.5, 0.5, 0.5, 0.5), 0.02),
        ("capsule", (0.01, 0.04), (1, 0, 0, 0), 0.03),
        ("capsule", (0.01, 0.04), (0.5**0.5, 0, 0.5**0.5, 0), 0.01),  # lying
        ("cylinder", (0.01, 0.04), (1, 0, 0, 0), 0.02),
        ("cylinder", (0.01, 0.04), (0.5**0.5, 0, 0.5**0.5, 0), 0.01),
    ],
)
def test_shapes_start_where_they_touch_the_table(shape, size, quat, height):
    item = ObjectCfg(shape=shape, size=size, quat=tuple(map(float, quat)))
    assert item.rest_height == pytest.approx(height, abs=1e-9)
    env = make("nero_lift", impl="native", scene=SceneCfg(objects={"cube": item}), events={})
    model, data = env.physics_model, mujoco.MjData(env.physics_model)
    mujoco.mj_forward(model, data)
    of_object = [c.dist for c in data.contact if "cube" in {model.geom(g).name for g in c.geom}]
    assert of_object and max(map(abs, of_object)) < 1e-6
    assert model.body("cube").mass[0] == pytest.approx(0.03)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"scene.objects.cube.shape": "cone"},
            "scene.objects.cube.shape must be one of box, sphere, capsule, cylinder, can, mesh, got 'cone'",
        ),
        ({"scene.objects.cube.size": (0.1,)}, "scene.objects.cube.size of a box is its three edges, got"),
        ({"scene.objects": {"cube": cube(0.03, 0.03), "link4": ObjectCfg()}}, "scene.objects.link4 needs another name"),
        ({"scene.objects": {}}, "observations.state.ee_to_object.params.object is 'cube', but the scene's objects are: none"),
        ({"events.reset_object_position.params.object": "ball"}, "events.reset_object_position.params.object is 'ball'"),
        ({"command.targets": ("picture",)}, "command.targets names picture: not one of cube"),
    ],
)
def test_impossible_objects_are_refused_in_one_line(changes, message):
    with pytest.raises(UserError, match=message):
        make("nero_lift", impl="native", **changes)


def test_a_shape_that_a_backend_cannot_collide_is_refused():
    """MJX-JAX has no routine for a cylinder that meets a box, such as a pad."""
    item = ObjectCfg(shape="cylinder", size=(0.01, 0.04))
    env = make("nero_lift", impl="jax", scene=SceneCfg(objects={"cube": item}))
    with pytest.raises(UserError, match="^MJX-JAX cannot compute this scene: .*CYLINDER"):
        env.physics  # noqa: B018


def test_a_group_stays_apart_through_reset_step_auto_reset_and_checkpoint(two, tmp_path):
    assert two.observation_size["parts"] == {"image": (8, 2), "blue": (3,)} and two.observation_size["state"] == (47,)
    train = wrappers.for_training(two)
    step, last = jax.jit(train.step), two.episode_length - 1
    state = jax.jit(train.reset)(jax.random.split(jax.random.PRNGKey(0), 8))
    for number in range(3):  # a step, a step that ends four episodes, a step
        before = state
        if number == 1:
            carry = state.info["carry"]
            late = carry.replace(step=jnp.where(jnp.arange(8) < 4, last, carry.step))
            before = state.replace(info={**state.info, "carry": late})
        action = jnp.full((8, 8), 0.5)
        state = step(before, action)
        parts = state.obs["parts"]
        assert parts["image"].shape == (8, 8, 2) and parts["blue"].shape == (8, 3)
        seen = state.info["carry"].action[:, :, None] * state.pipeline_state.qpos[:, None, :2]
        noise = np.asarray(parts["image"] - seen)
        assert (np.abs(noise) <= 0.1 + 1e-6).all() and noise.std() > 0.04
        np.testing.assert_allclose(parts["blue"], state.pipeline_state.qpos[:, BLUE][:, :3], atol=1e-6)
    assert state.done.sum() == 0 and int((state.info["steps"] == 1).sum()) == 4
    checkpoint.save(tmp_path / "state.safetensors", state, {"kind": "test"})
    again = checkpoint.load(tmp_path / "state.safetensors", jax.eval_shape(lambda: state))
    jax.tree.map(np.testing.assert_array_equal, again, state)


# --- late actions and observations


def test_actions_come_late_and_the_policy_sees_its_own():
    env = make("nero_lift", impl="native", actions={"delay": Term(actions.Delay, params={"steps": (3, 3)}), **joint_actions()})
    prompt = make("nero_lift", impl="native", actions=joint_actions())
    late, now = (jax.jit(e.reset)(jax.random.PRNGKey(0)) for e in (env, prompt))
    np.testing.assert_array_equal(late.pipeline_state.qpos, now.pipeline_state.qpos)  # nothing else is drawn otherwise
    sent = [jax.random.normal(jax.random.PRNGKey(i), (8,)) for i in range(6)]
    home = jnp.zeros(8)
    for i, action in enumerate(sent):
        now = jax.jit(prompt.step)(now, sent[i - 3] if i >= 3 else home)
        late = jax.jit(env.step)(late, action)
        np.testing.assert_array_equal(late.pipeline_state.ctrl, now.pipeline_state.ctrl)
        np.testing.assert_array_equal(late.pipeline_state.qpos, now.pipeline_state.qpos)
        np.testing.assert_array_equal(late.info["carry"].action, action)


def test_observations_come_late_and_begin_anew_with_the_episode():
    state = {
        "goal": ObservationTerm(observations.command),
        "time": ObservationTerm(lambda view: view.time[None], delay=(2, 2)),
        "times": ObservationTerm(lambda view: view.time[None], history=3),
        "both": ObservationTerm(lambda view: view.time[None], delay=(1, 1), history=2),
    }
    env = make("nero_lift", impl="native", observations={"state": ObservationGroup(state, corruption=False)})
    train = wrappers.for_training(env)
    step, now = jax.jit(train.step), jax.jit(train.reset)(jax.random.split(jax.random.PRNGKey(0), 2))
    carry = now.info["carry"]
    now = now.replace(info={**now.info, "carry": carry.replace(step=carry.step + env.episode_length - 3)})
    seen = []
    for _ in range(7):
        now = step(now, jnp.zeros((2, 8)))
        seen.append((np.asarray(now.obs["state"][0, 3:]) / 0.02).round().astype(int).tolist())
        named = jax.jit(env.named_observations)(now)["state"]  # of a batch, as it is now
        np.testing.assert_allclose(named["time"][:, 0], now.info["carry"].step * 0.02, atol=1e-6)
    # The third step ends the episode: from there on, time begins at 0.
    assert seen[2:] == [[0, 0, 0, 0, 0, 0], [0, 0, 0, 1, 0, 0], [0, 0, 1, 2, 0, 1], [1, 1, 2, 3, 1, 2], [2, 2, 3, 4, 2, 3]]


def test_an_action_of_another_size_is_refused_in_one_line():
    env = make("nero_lift", impl="native")
    state = jax.jit(env.reset)(jax.random.PRNGKey(0))
    with pytest.raises(UserError, match=r"^an action is 8 numbers, got an array of shape \(7,\): jax.vmap the step"):
        env.step(state, jnp.zeros(7))


def test_an_action_whose_reward_overflows_is_a_sick_one(batch):
    state = batch.reset(0)
    after = batch.step(state, jnp.zeros((8, 8)).at[3, 2].set(1e30))
    only = np.arange(8) == 3
    np.testing.assert_array_equal(after.metrics["nan"], only)
    np.testing.assert_array_equal(after.done, only)
    assert jnp.isfinite(after.reward).all() and float(after.reward[3]) == 0


def test_products_are_exact_whatever_the_program_has_set():
    """Matrix products in the environment's program ask for full precision, though the program's default is less."""
    turn = ObservationTerm(lambda view: jnp.eye(3) @ view.ee_pos_w)
    env = make("nero_lift", impl="native", observations={"state": ObservationGroup({"turned": turn})})
    state = env.state_shape
    with jax.default_matmul_precision("default"):
        for program in (
            jax.jit(env.reset).lower(jax.random.PRNGKey(0)),
            jax.jit(env.step).lower(state, jax.ShapeDtypeStruct((8,), jnp.float32)),
        ):
            products = [line for line in program.as_text().splitlines() if "dot_general" in line]
            assert products and all("HIGHEST" in line for line in products)


def test_randomised_starts_of_each_object_are_its_own():
    box = {"x": (0.3, 0.4), "y": (0.1, 0.2), "z": (0.0, 0.0)}
    scene = dataclasses.replace(CFG.scene, objects={**CFG.scene.objects, "blue": ObjectCfg()})
    own = {"blue": Term(events.object_position_uniform, params={**box, "object": "blue"})}
    env = make("nero_lift", impl="native", scene=scene, events={**CFG.events, **own})
    qpos = jax.jit(jax.vmap(lambda key: env.sample(key)[0].qpos))(jax.random.split(jax.random.PRNGKey(0), 200))
    blue, red = qpos[:, BLUE], qpos[:, RED]
    assert (blue[:, 1] >= 0.1 - 1e-6).all() and (red[:, 1] < 0.05).any()
    assert abs(np.corrcoef(blue[:, 0], red[:, 0])[0, 1]) < 0.2
