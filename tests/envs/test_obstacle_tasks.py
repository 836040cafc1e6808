"""Tasks with obstacles: what is drawn, what counts as a touch, what is refused, and experts that touch nothing."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_nero import UserError, env_cfg, make
from mjx_nero.envs import regions
from mjx_nero.runs import evaluation
from mjx_nero.sim import scene, touch
from mjx_nero.sim.scene import ObjectCfg, ObstacleCfg, SceneCfg, SimCfg
from mjx_nero.tasks import reach_obstacles, registry
from mjx_nero.tasks.arms.nero import NERO

N = 8


@pytest.fixture(scope="module")
def env():
    return make("nero_reach_obstacles", impl="native", num_envs=N, **{"obstacles.params.kinds": ("wall",)})


@pytest.fixture(scope="module")
def played(env):
    """Episodes in which the arm stays where it starts for half a second, and others in which its first joint then sweeps to the
    goal's side: touches [steps, 2, n] and the last states."""
    step = jax.jit(jax.vmap(env.step))
    start = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), N))
    runs, touches = [start, start], []
    still = np.asarray((start.pipeline_state.ctrl[:, :7] - env.home_action) / 0.5)
    for k in range(120):
        sweep = still.copy()
        sweep[:, 0] += 2.4 * min(1.0, max(0, k - 25) / 50)  # by 1.2 rad
        runs = [step(state, jnp.asarray(action)) for state, action in zip(runs, (still, sweep), strict=True)]
        touches.append([np.asarray(state.pipeline_state.readings["touch"]) for state in runs])
    return start, np.array(touches), runs


def test_every_environment_has_its_own_wall_between_start_and_goal(env, played):
    view = jax.jit(jax.vmap(env.view))(played[0])
    wall, way = view.obstacles["one"], view.goal_pos_w - view.ee_pos_w
    share = jnp.sum((wall.pos_w - view.ee_pos_w)[:, :2] * way[:, :2], axis=1) / jnp.sum(way[:, :2] ** 2, axis=1)
    assert ((share > 0.25) & (share < 0.75)).all() and len(np.unique(np.asarray(wall.pos_w)[:, 0])) == N
    seen = jax.jit(env.named_observations)(played[0])["state"]["obstacle_one"]
    np.testing.assert_allclose(
        seen, jnp.concatenate([wall.pos_w, wall.quat_w, wall.size], axis=1), atol=1e-6
    )  # the root is the origin


def test_an_arm_that_stays_touches_nothing_and_one_that_sweeps_hits_the_wall(env, played):
    _, touches, (still, swept) = played
    assert not touches[:, 0].any() and not touches[:26].any()
    assert (touches[:, 1].max(axis=0) > 1.0).all()
    view = jax.jit(jax.vmap(env.view))(swept)
    stopped = jnp.linalg.norm(view.ee_pos_w - view.goal_pos_w, axis=1)
    assert (stopped > 0.1).all()  # behind the wall
    memory = swept.info["carry"].memory
    assert memory["success.condition"].all() and memory["metrics.touched"].all()
    assert not still.info["carry"].memory["metrics.touched"].any()


def test_scenes_without_obstacles_are_as_they_were():
    model = scene.build(NERO, SceneCfg(), SimCfg())
    names = {model.geom(i).name for i in range(model.ngeom)}
    assert not names & {"upper_arm", "elbow", "base"} and model.npair == model.nsensor == 0
    whole = scene.build(NERO, SceneCfg(obstacles={"one": ObstacleCfg()}), SimCfg())
    assert {whole.geom(i).name for i in range(whole.ngeom)} - names == {"upper_arm", "elbow", "base", "one"}


def test_the_cobotta_can_hit_its_own_column():
    cfg = env_cfg("cobotta_reach_obstacles")
    pairs = touch.self_pairs(cfg.robot)
    assert ("column", "palm") in pairs and ("upper_arm", "palm") in pairs
    parts = {"palm", "left_pad", "left_tip", "right_pad", "right_tip"}
    assert not any({a, b} <= parts or {a, b} <= {"upper_arm", "elbow"} for a, b in pairs)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"objects": {"can": ObjectCfg("cylinder", (0.02, 0.06))}},
            "scene.obstacles cannot meet 'can', a cylinder: only spheres, capsules, boxes and meshes meet boxes on every backend",
        ),
        (
            {"obstacles": {"cube": ObstacleCfg()}},
            "scene.obstacles.cube needs another name: the robot or the scene already uses it",
        ),
    ],
)
def test_impossible_obstacles_are_refused_in_one_line(changes, message):
    made = dataclasses.replace(SceneCfg(obstacles={"one": ObstacleCfg()}), **changes)
    with pytest.raises(UserError) as error:
        scene.build(NERO, made, SimCfg())
    assert str(error.value) == message


def test_names_that_the_scene_lacks_are_refused():
    cfg = env_cfg("nero_reach_obstacles")
    env = make("nero_reach_obstacles", impl="native", **{"obstacles.params.names": ("one", "three")})
    with pytest.raises(UserError, match="obstacles draws three, but the scene's obstacles are: one, two"):
        jax.eval_shape(env.sample, jax.random.PRNGKey(0))
    plain = dataclasses.replace(env_cfg("nero_reach"), success=cfg.success)
    with pytest.raises(UserError, match="terms of touch need scene.obstacles or scene.self_collision, and this task has neither"):
        jax.eval_shape(evaluation.ManipulationEnv(plain, impl="native").step, *_shapes(plain))


def _shapes(cfg):
    env = evaluation.ManipulationEnv(cfg, impl="native")
    return env.state_shape, jnp.zeros(env.action_size)


@pytest.mark.parametrize(("robot", "x", "y"), [("nero", 0.33, -0.2), ("cobotta_pro_900", 0.5, 0.27)])
def test_the_first_joint_turns_the_arm_aside(robot, x, y):
    """At home both point along x, their first axis stands upright at the origin."""
    assert regions.turn_to(registry.robot(robot), x, y) == pytest.approx(np.arctan2(y, x), abs=2e-3)


def test_experts_of_robots_without_rmpflow_go_by_inverse_kinematics(tmp_path):
    stranger = dataclasses.replace(registry.robot("piper"), folder=str(tmp_path))
    assert reach_obstacles.controllers(stranger, "detour")["detour"]["motion"] == "ik"
    for robot in registry.list_robots():
        for name, expert in (("reach_obstacles", "detour"), ("lift_obstacles", "carry")):
            assert "motion" not in env_cfg(name, robot=robot).controllers[expert]


@pytest.mark.parametrize("arm", ["piper", "so100", "so101"])
def test_there_is_room_for_obstacles_between_start_and_goal(arm):
    """In every episode; and nothing touches at the start."""
    for task in ("reach_obstacles", "lift_obstacles"):
        env = make(f"{arm}_{task}", impl="native", num_envs=64)
        state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 64))
        boxes = jax.jit(jax.vmap(env.view))(state).obstacles.values()
        assert (np.stack([box.pos_w[:, 2] for box in boxes]) > 0).any(axis=0).all()
        still = jax.jit(jax.vmap(env.finish, (0, None, 0, None)))
        held = env.physics.step(state.pipeline_state, state.pipeline_state.ctrl)[0]
        assert (still(state, env.home_action, held, jnp.zeros(())).pipeline_state.readings["touch"] == 0).all()


def test_a_touch_costs_a_beginner_a_tenth():
    """And all of it where there is no level: everywhere but in training."""
    env = make("nero_lift_obstacles", impl="native")
    touched, still, reset, advance = jnp.asarray(2.0), jnp.zeros(env.action_size), jax.jit(env.reset), jax.jit(env.advance)
    for level, price in ((0.0, -1.0), (0.5, -5.5), (1.0, -10.0), (None, -10.0)):
        state = reset(jax.random.PRNGKey(0), level)
        after = advance(state, still, state.pipeline_state.replace(readings={"touch": touched}), jnp.zeros(()))
        assert float(after.metrics["reward/touching"]) == pytest.approx(price * env.dt)


@pytest.mark.slow
def test_nero_reaches_past_obstacles_without_a_touch():
    cfg = evaluation.EvalCfg("nero_reach_obstacles", controller="expert", episodes=64, backend="mujoco")
    result = evaluation.play(cfg).result
    assert result["success_rate"] >= 0.95 and result["touched_mean"] <= 0.02


@pytest.mark.slow
def test_cobotta_lifts_past_obstacles_without_a_touch():
    cfg = evaluation.EvalCfg("cobotta_lift_obstacles", controller="expert", episodes=64, backend="mujoco")
    result = evaluation.play(cfg).result
    assert result["success_rate"] >= 0.9 and result["touched_mean"] <= 0.03
