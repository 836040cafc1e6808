"""Lift any: which shapes come, how they lie, what their worlds weigh, what counts as held, and the expert that lifts them."""

import dataclasses
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjx_nero import UserError, control, env_cfg, make
from mjx_nero.control import grasp_thing
from mjx_nero.envs import things, wrappers
from mjx_nero.learn.ppo import learner as ppo
from mjx_nero.mdp import observations, rewards
from mjx_nero.runs import cfg as run_cfg
from mjx_nero.runs import evaluation
from mjx_nero.sim import scene, solids
from mjx_nero.sim.meshes import bank, events
from mjx_nero.sim.meshes import body as bodies
from mjx_nero.sim.physics.mjx import JaxPhysics
from mjx_nero.sim.solids import grasps, rests, shapes
from mjx_nero.tasks import lift_any, registry
from mjx_nero.tasks.lift_any import HELD_OUT, SEEN, THING
from mjx_nero.types import SHAPE, ObjectView, ShapeView, Start

WORLDS = 64


@pytest.fixture(scope="module")
def worlds():
    return make("nero_lift_any", impl="native", num_envs=WORLDS)


@pytest.fixture(scope="module")
def starts(worlds):
    return jax.jit(jax.vmap(worlds.reset))(jax.random.split(jax.random.PRNGKey(0), WORLDS))


@pytest.fixture(scope="module")
def see(worlds):
    """The thing in the views of a batch."""
    return jax.jit(jax.vmap(lambda state: worlds.view(state).objects[THING]))


def test_a_drawn_colour_stays_and_the_other_shapes_are_hidden(worlds):
    model, count = worlds.mj_model, len(SEEN)
    drawn = jnp.full((model.ngeom, 4), 0.5)
    banks = bank.Banks(worlds.physics_model, worlds.cfg.scene.objects, lambda: model)
    third = SimpleNamespace(memory={SHAPE: {THING: jnp.array(2)}})
    rgba = banks.scenery(None, third, {"geom_rgba": drawn})["look"]["geom_rgba"]
    rows = np.array([model.geom(bodies.drawn_name(THING, k)).id for k in range(count)])
    assert rgba[rows, 3].tolist() == [float(k == 2) for k in range(count)]
    np.testing.assert_array_equal(rgba[:, :3], drawn[:, :3])
    np.testing.assert_array_equal(np.delete(rgba[:, 3], rows), 0.5)


def test_a_quarter_is_held_out():
    assert len(HELD_OUT) == 3 and len(SEEN) == 9 and {*HELD_OUT, *SEEN} == set(solids.names())
    for preset, files in (("default", SEEN), ("held_out", HELD_OUT), ("all", (*SEEN, *HELD_OUT))):
        item = env_cfg("nero_lift_any", preset).scene.objects[THING]
        assert (item.file, *item.bank) == files


def test_every_world_has_the_masses_of_its_shape(worlds, starts, see):
    """What MuJoCo's compiler computes of a scene with that one shape."""
    fields, index = starts.pipeline_state.fields, np.asarray(starts.pipeline_state.fields["geom_dataid"])
    which = np.asarray(see(starts).shape.index)
    assert set(which) == set(range(len(SEEN)))
    for k, name in enumerate(SEEN):
        (world, *_) = np.flatnonzero(which == k)
        alone = scene.build(worlds.cfg.robot, one(worlds, name), worlds.cfg.sim, visuals=False, fuse=True)
        body, dof = alone.body(THING).id, alone.joint(THING).dofadr[0]
        for field in ("body_mass", "body_inertia", "body_iquat", "body_invweight0", "body_subtreemass"):
            assert np.asarray(fields[field])[world, body] == pytest.approx(getattr(alone, field)[body], rel=1e-4, abs=1e-9), field
        for field in ("dof_invweight0", "dof_M0"):
            assert np.asarray(fields[field])[world, dof:][:6] == pytest.approx(getattr(alone, field)[dof:][:6], rel=1e-4)
        assert np.asarray(fields["body_subtreemass"])[world, 0] == pytest.approx(alone.body_subtreemass[0], rel=1e-5)
        ids = index[world][[worlds.physics_model.geom(g).id for g in bodies.names(THING, worlds.cfg.scene.objects[THING].solids)]]
        assert (ids >= 0).sum() == 1 + len(solids.find(name).sizes)


def one(worlds, name):
    return dataclasses.replace(worlds.cfg.scene, objects={THING: lift_any.thing((name,))})


def test_a_world_steps_as_a_scene_of_its_shape_alone(worlds, starts, see):
    """Ten control steps of each shape, the thing 2 cm above the table and turned, against MuJoCo itself."""
    which = np.asarray(see(starts).shape.index)
    at = int(worlds.physics_model.joint(THING).qposadr[0])
    state = starts.pipeline_state
    lifted = dataclasses.replace(state, qpos=state.qpos.at[:, at + 2].add(0.02).at[:, at + 1].add(1.0))
    step, after = jax.jit(jax.vmap(worlds.physics.step)), lifted
    for _ in range(10):
        after, _ = step(after, state.ctrl)
    for k, name in enumerate(SEEN):
        (world, *_) = np.flatnonzero(which == k)
        alone = scene.build(worlds.cfg.robot, one(worlds, name), worlds.cfg.sim, visuals=False, fuse=True)
        data = mujoco.MjData(alone)
        data.qpos[:], data.ctrl[:] = np.asarray(lifted.qpos)[world], np.asarray(state.ctrl)[world]
        for _ in range(10 * worlds.cfg.sim.decimation):
            mujoco.mj_step(alone, data)
        assert np.asarray(after.qpos)[world, at:][:3] == pytest.approx(data.qpos[at:][:3], abs=2e-4), name


def test_things_lie_as_they_rest(worlds, starts, see):
    """After a second with the arm at home no thing has moved by more than 2 mm, or turned."""
    step, state = jax.jit(jax.vmap(worlds.step)), starts
    for _ in range(25):
        state = step(state, jnp.tile(worlds.home_action, (WORLDS, 1)))
    before, after = see(starts), see(state)
    assert np.linalg.norm(after.pos_w - before.pos_w, axis=1).max() < 2e-3
    for a, b in zip(np.asarray(before.quat_w), np.asarray(after.quat_w), strict=True):
        assert rests.up(a) @ rests.up(b) > np.cos(0.03)
    assert not np.asarray(state.metrics["nan"]).any()


def test_rests_are_drawn_as_often_as_they_come():
    """Of a mug alone, 4,000 times; and a full turn about the vertical."""
    pos = {"cube": jnp.array([0.1, 0.2, 0.0])}
    blank = Start(joint_pos=jnp.zeros(1), object_pos_w=pos, object_quat_w={"cube": jnp.array([1.0, 0, 0, 0])})
    draw = jax.jit(jax.vmap(lambda key: events.at_rest(key, blank, files=("mug",))))
    drawn = draw(jax.random.split(jax.random.PRNGKey(1), 4000))
    mug = solids.find("mug")
    ups = np.array([rests.up(quat) for quat in np.asarray(drawn.object_quat_w["cube"])])
    own = np.array([rests.up(quat) for quat in mug.rest_quat])
    which = (ups @ own.T).argmax(1)
    assert (ups @ own.T).max(1).min() > 0.9999
    assert np.bincount(which, minlength=len(own)) / 4000 == pytest.approx(mug.rest_share, abs=0.03)
    heights = np.array([mug.height(quat) for quat in mug.rest_quat])[which]
    assert np.asarray(drawn.object_pos_w["cube"]) == pytest.approx(
        np.column_stack([np.full((4000, 2), (0.1, 0.2)), heights]), abs=1e-5
    )


def test_some_of_the_shapes_in_another_order_are_those_that_are_named():
    """Of a bank of three, the last and the first: the shape that a world has is the one that lies there."""
    bank = {"scene.objects.thing.file": "mug", "scene.objects.thing.bank": ("hammer", "ring")}
    env = make("nero_lift_any", impl="native", **bank, **{"events.reset_object_shape.params.files": ("ring", "mug")})
    event = env.cfg.events["reset_object_shape"]
    drawn = jax.jit(jax.vmap(lambda key: event(key, env.blank().start)))(jax.random.split(jax.random.PRNGKey(0), 64))
    which, poses = np.asarray(drawn.shape[THING]), (drawn.object_pos_w[THING], drawn.object_quat_w[THING])
    assert {*which} == {0, 2}
    for shape, pos, quat in zip(which, *map(np.asarray, poses), strict=True):
        solid = solids.find(("mug", "hammer", "ring")[shape])
        assert pos[2] == pytest.approx(solid.height(quat), abs=1e-4)
    with pytest.raises(UserError, match="files names spoon, but file and bank of scene.objects.thing are mug, hammer, ring"):
        make("nero_lift_any", impl="native", **bank, **{"events.reset_object_shape.params.files": ("spoon",)})


def mesh_view(view, name: str, pos, quat=(1.0, 0.0, 0.0, 0.0)):
    solid = solids.find(name)
    middle, edges = shapes.box(solid)
    shape = ShapeView(
        jnp.zeros((), jnp.int32),
        *(jnp.asarray(x, jnp.float32) for x in (shapes.points(solid), middle, edges, shapes.code(solid))),
    )
    still = {"linvel_w": jnp.zeros(3), "angvel_local": jnp.zeros(3)}
    thing = ObjectView(pos_w=jnp.asarray(pos, jnp.float32), quat_w=jnp.asarray(quat, jnp.float32), shape=shape, **still)
    return dataclasses.replace(view, objects={"cube": thing})


def test_held_counts_from_the_surface(finish):
    """A hammer on end, 20 cm tall: its lowest point counts, and the box around it."""
    view = finish.env.view(finish.reset(jax.random.PRNGKey(0)))
    solid, up = solids.find("hammer"), (0.5**0.5, 0.0, -(0.5**0.5), 0.0)  # its x axis, the handle, points up
    low = solid.height(np.array(up))
    ee = np.asarray(view.ee_pos_w)
    for pos, held in (
        ([ee[0], ee[1], low + 0.011], True),  # 11 mm above the table, the handle through the grasp point
        ([ee[0], ee[1], low + 0.009], False),
        ([ee[0] + 0.2, ee[1], low + 0.011], False),
    ):
        seen = mesh_view(view, "hammer", pos, up)
        seen = dataclasses.replace(seen, ee_pos_w=jnp.array([ee[0], ee[1], low + 0.05]))
        assert bool(rewards.held(seen, minimal_height=0.01, grasp_radius=0.03)) == held
    code = observations.object_shape(mesh_view(view, "hammer", ee))
    assert code.shape == (17,) and (np.asarray(code) > 0).all()
    assert np.asarray(code)[:14].max() == pytest.approx((solid.hull @ shapes.DIRECTIONS[shapes.CODED].T).max(), abs=1e-6)
    with pytest.raises(UserError, match="object_shape reads the shape of a mesh, but 'cube' is not a mesh"):
        observations.object_shape(view)


def test_grasps_of_a_bar(tmp_path):
    """A bar of 20 cm, 3 cm wide: from above, across its width and near its middle; a hand too small finds none."""
    import trimesh

    trimesh.creation.box((0.2, 0.03, 0.04)).export(tmp_path / "bar.stl")
    solid = solids.find(str(tmp_path / "bar.stl"))
    hand = grasps.Hand(opening=0.08, closed=0.0, pad=(0.01, 0.02, 0.006), lowest=0.01)
    flat = next(quat for quat in solid.rest_quat if abs(rests.up(quat)[2]) > 0.99)
    found = grasps.find(solid, flat, hand)
    assert len(found.cost) and (np.diff(found.cost) >= 0).all()
    best = found.middle[0], found.across[0], found.gap[0]
    assert abs(best[0][0]) < 0.02 and abs(best[1][1]) > 0.99 and 0.03 < best[2] < 0.06
    assert (np.abs(found.middle[:, 0]) <= 0.1).all()
    assert not len(grasps.find(solid, flat, dataclasses.replace(hand, opening=0.03)).cost)


@pytest.mark.parametrize("robot", ["nero", "cobotta_pro_900"])
def test_hands_can_grasp_every_object(robot):
    """In nearly every way in which it rests: the lines of the best grasps meet its parts on both sides."""
    hand = grasp_thing.hand_of(registry.robot(robot))
    for name in ("mug", "wrench"):
        solid = solids.find(name)
        for quat in solid.rest_quat[:2]:
            found = grasps.find(solid, quat, hand)
            assert len(found.cost), name
            assert (found.gap <= hand.opening).all() and np.abs(np.linalg.norm(found.across, axis=1) - 1).max() < 1e-6
            assert np.abs(found.across @ rests.up(quat)).max() < 1e-6  # level


def test_jax_says_what_it_cannot(worlds):
    with pytest.raises(UserError, match="MJX-JAX cannot give an object another shape in each episode"):
        JaxPhysics(worlds.physics_model, worlds.cfg.sim, worlds._parts.fields)


def test_object_in_the_place_of_the_cube():
    """``--object``: its rests, its grasps, its size; tasks that have no such object say so."""
    cfg, cube = env_cfg("nero_lift", **{"object.file": "hammer", "object.scale": 0.8}), env_cfg("nero_lift")
    assert (cfg.sim.dt, cfg.sim.decimation) == (cube.sim.dt / 2, 2 * cube.sim.decimation)
    assert cfg.episode_length_s == cube.episode_length_s + 2.0 < cfg.command.resample_s
    asked = env_cfg("nero_lift", **{"episode_length_s": 4.0, "object.file": "hammer", "scene.objects.cube.pos": (0.4, 0.0, 0.1)})
    assert (asked.episode_length_s, asked.scene.objects["cube"].pos) == (4.0, (0.4, 0.0, 0.1))
    assert things.applied(asked) == asked
    item = cfg.scene.objects["cube"]
    assert (item.shape, item.file, item.scale) == ("mesh", "hammer", 0.8)
    assert cfg.controllers["grasp_thing"]["files"] == ("hammer",) and list(cfg.events)[-1] == "reset_object_shape"
    assert cfg.rewards["holding_object"].params["minimal_height"] == 0.01
    pushed = env_cfg("nero_push", **{"object.file": "mug"})
    assert pushed.success.condition.params["fold"] == 1 and not pushed.controllers
    for env_name, thing, says in (
        ("nero_clutter", "mug", "one object that a task lifts, pushes or places, but this task has several objects of their own"),
        ("nero_stack", "mug", "but this task has several objects"),
        ("nero_reach", "mug", "but this task has none"),
        ("nero_push", "screwdriver", "cannot stand in its orientation"),
        ("nero_lift", "mugg", "did you mean 'mug'"),
    ):
        with pytest.raises(UserError, match=says):
            env_cfg(env_name, **{"object.file": thing})


@pytest.mark.parametrize(("file", "stands"), [("mug", True), ("bottle", True), ("screwdriver", False), ("dumbbell", False)])
def test_object_in_the_place_of_the_box(file, stands):
    """It starts and ends as its file has it, or as it mostly rests; start and goal differ by place and heading alone."""
    cfg = env_cfg("nero_place", **{"object.file": file})
    env = make("nero_place", impl="native", **{"object.file": file})
    item, solid = cfg.scene.objects["box"], solids.find(file)
    assert env.cfg.scene.objects == cfg.scene.objects and env.cfg.controllers == cfg.controllers  # once, not twice
    up = rests.up(np.array(item.quat))
    assert (up[2] > 0.999) == stands
    if not stands:
        assert up == pytest.approx(rests.up(solid.rest_quat[solid.rest_share.argmax()]), abs=1e-5)
    start = jax.jit(jax.vmap(lambda key: env.sample(key)[0].qpos))(jax.random.split(jax.random.PRNGKey(0), 8))
    goal = jax.vmap(cfg.command)(jax.random.split(jax.random.PRNGKey(1), 8))
    at = int(env.physics_model.joint("box").qposadr[0])
    for quat in (*np.asarray(start)[:, at + 3 : at + 7], *np.asarray(goal[1])):
        assert rests.up(quat) == pytest.approx(up, abs=1e-5)
    heights = np.asarray(start)[:, at + 2], np.asarray(goal[0])[:, 2] + cfg.robot.base_pos[2]
    assert np.concatenate(heights) == pytest.approx(solid.height(np.array(item.quat)), abs=1e-3)
    assert {"put_thing"} == {*cfg.controllers} and cfg.controllers["put_thing"]["turns"] == 1
    assert cfg.rewards["standing"].params["place"] == cfg.success.condition.params["place"]


@pytest.mark.slow
@pytest.mark.parametrize("file", ["mug", "dumbbell"])
def test_expert_places_a_thing(file):
    """Eight episodes; ``docs/guides/objects.md`` has more. The dumbbell lies on another side than its file's."""
    fields = {"object.file": file}
    played = evaluation.play(evaluation.EvalCfg("nero_place", impl="native", controller="expert", episodes=8, env_fields=fields))
    assert played.result["success_rate"] >= 0.75, played.result


def test_grasp_thing_takes_files():
    with pytest.raises(UserError, match="grasp_thing needs files"):
        control.make("grasp_thing", registry.robot("nero"), 0.02)


@pytest.mark.slow
def test_expert_lifts_things():
    """Sixteen episodes; ``docs/guides/objects.md`` has more."""
    played = evaluation.play(evaluation.EvalCfg("nero_lift_any", impl="native", controller="expert", episodes=16, seed=3))
    assert played.result["success_rate"] >= 0.6, played.result


def test_a_shape_without_an_episode_has_no_success_rate():
    thing = SimpleNamespace(file="mug", bank=("ring", "jack"))
    env = SimpleNamespace(cfg=SimpleNamespace(scene=SimpleNamespace(objects={"thing": thing})))
    episodes = SimpleNamespace(metrics={"shape/thing": np.array([0.0, 1.0, 1.0])}, success=np.array([True, True, False]))
    assert evaluation._by_shape(env, episodes) == {"mug": [1.0, 1], "ring": [0.5, 2], "jack": [None, 0]}


def test_an_iteration_of_the_learner_keeps_the_states_shape():
    """Ends of episodes, starts where the expert was, and the update take worlds of different shapes; nothing is compiled."""
    env = make("nero_lift_any", impl="native", num_envs=8)
    cfg = dataclasses.replace(run_cfg.learner_cfg(env.cfg, "default"), num_envs=8)
    learner = ppo.Learner(wrappers.for_training(env), cfg)
    visited = jax.tree.map(lambda x: jnp.broadcast_to(x, (8, *x.shape)), env.blank())
    state = jax.eval_shape(learner.init, jax.random.PRNGKey(0), visited)
    after, metrics = jax.eval_shape(lambda state: learner.run(state, 1), state)
    assert jax.tree.map(lambda x: (x.shape, x.dtype), after) == jax.tree.map(lambda x: (x.shape, x.dtype), state)
    assert "sum/success" in metrics


def test_the_flag(call):
    """``--object`` is the field ``env.object.file``, whose faults are one line."""
    for command in ("eval", "train"):
        code, _, err = call(command, "--env", "nero_clutter", "--object", "mug")
        assert code == 2 and err.startswith("error: object replaces the one object that a task lifts, pushes or"), err
    code, _, err = call("eval", "--env", "nero_lift", "--object", "none.stl")
    assert code == 2 and err.startswith("error: cannot read none.stl")
