"""Model fields that differ from world to world: what is drawn, what follows from it, and equal physics on all backends."""

import copy

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjx_nero import UserError, make
from mjx_nero.envs import wrappers
from mjx_nero.learn import policy
from mjx_nero.mdp import randomization
from mjx_nero.mdp.terms import Term
from mjx_nero.sim.physics.mjx import JaxPhysics

CUBE = {"cube": Term(randomization.mass, params={"bodies": ("cube",), "scale": (0.5, 4.0)})}
PADS = {
    "pads": Term(
        randomization.friction,
        params={"geoms": ("pad1", "pad2"), "slide": (0.3, 1.5), "spin": (1e-4, 2e-2), "roll": (1e-5, 5e-3)},
    )
}
ARM = {
    "links": Term(randomization.mass, params={"bodies": ("link2", "link4"), "scale": (0.5, 2.0)}),
    "joints": Term(randomization.joints, params={"joints": ("joint1", "joint5"), "armature": (0.5, 2.0), "damping": (0.5, 2.0)}),
    "drives": Term(
        randomization.gains, params={"actuators": ("joint1", "joint4"), "stiffness": (0.7, 1.5), "damping": (0.5, 2.0)}
    ),
}


CENTERS = {"centers": Term(randomization.center_of_mass, params={"bodies": ("link2", "link4"), "offset": 0.02})}
REST = {
    "size": Term(randomization.size, params={"scale": (0.8, 1.2)}),
    "dry": Term(randomization.joints, params={"joints": ("joint1", "joint2", "joint6"), "friction": (0.02, 0.1)}),
    "effort": Term(randomization.gains, params={"actuators": ("joint1", "joint2"), "effort": (0.02, 0.1)}),
    "encoders": Term(randomization.encoder_bias, params={"actuators": ("joint2", "joint6"), "bias": 0.05}),
}


def drawn(env, n):
    return jax.jit(jax.vmap(lambda key: env.sample(key)[0].fields))(jax.random.split(jax.random.PRNGKey(0), n))


@pytest.fixture(scope="module")
def env():
    return make("nero_lift", impl="native", corruption=False, randomization={**CUBE, **PADS})


@pytest.fixture(scope="module", params=["cube and pads", "all"])
def worlds(request, env):
    """What the backends have to agree on."""
    if request.param != "all":
        return env
    terms = {**CUBE, **PADS, **ARM, **CENTERS, **REST}
    return make("nero_lift", impl="native", corruption=False, randomization=terms)


def test_masses_and_frictions_fill_their_ranges_world_by_world(env):
    model, fields = env.physics_model, drawn(env, 500)
    cube, pads = model.body("cube").id, [model.geom(name).id for name in ("pad1", "pad2")]
    factor = fields["body_mass"][:, cube] / 0.03
    assert 0.5 <= factor.min() < 0.55 and 3.9 < factor.max() <= 4.0
    # The inertia of a cube is m a^2 / 6.
    inertia = fields["body_mass"][:, cube] * 0.03**2 / 6
    np.testing.assert_allclose(fields["body_inertia"][:, cube], np.tile(inertia, (3, 1)).T, rtol=1e-5)
    friction = np.asarray(fields["geom_friction"])[:, pads]
    for column, (low, high), middle in [(0, (0.3, 1.5), 0.9), (1, (1e-4, 2e-2), 2**0.5 * 1e-3), (2, (1e-5, 5e-3), 5**0.5 * 1e-4)]:
        values = friction[..., column]
        assert low <= values.min() and values.max() <= high * (1 + 1e-6)
        assert np.median(values) == pytest.approx(middle, rel=0.2)  # of the logarithm's range in the last two
    assert abs(np.corrcoef(friction[:, 0, 0], friction[:, 1, 0])[0, 1]) < 0.2 and (friction[:, 0] != friction[:, 1]).all()
    others = np.delete(np.arange(model.nbody), cube)
    np.testing.assert_array_equal(fields["body_mass"][:, others], np.tile(np.float32(model.body_mass[others]), (500, 1)))


@pytest.mark.parametrize("terms", [CUBE, {**CUBE, **ARM, **CENTERS}], ids=["a free body", "a chain, too"])
def test_constants_follow_as_mujoco_computes_them(terms):
    env = make("nero_lift", impl="native", randomization=terms)
    fields, nominal = drawn(env, 4), env.physics_model
    derived = ("body_subtreemass", "body_invweight0", "dof_invweight0", "dof_M0")
    assert set(derived) <= set(fields)
    for i in range(4):
        model = copy.copy(nominal)
        for name in fields:
            if name not in derived:
                getattr(model, name)[:] = fields[name][i]
        mujoco.mj_setConst(model, mujoco.MjData(model))
        for name in derived:
            np.testing.assert_allclose(fields[name][i], getattr(model, name), rtol=2e-6, atol=1e-9)
            assert not np.allclose(getattr(model, name), getattr(nominal, name), rtol=0.01)


def test_sizes_frictions_efforts_and_biases_fill_their_ranges_and_keep_to_physics():
    env = make("nero_lift", impl="native", randomization=REST)
    keys = jax.random.split(jax.random.PRNGKey(0), 200)
    sim = jax.jit(jax.vmap(lambda key: env.sample(key)[0]))(keys)
    fields, cube = sim.fields, env.physics_model.geom("cube").id
    factor = fields["geom_size"][:, cube, 0] / 0.015
    assert 0.8 <= factor.min() < 0.81 and 1.19 < factor.max() <= 1.2 + 1e-6
    np.testing.assert_allclose(fields["geom_size"][:, cube], np.tile(0.015 * factor, (3, 1)).T, rtol=1e-6)
    # A cube of edge a has the inertia m a^2 / 6, and its corners are sqrt(3) a / 2 from its centre, which rests at a / 2.
    inertia = 0.03 * (0.03 * factor) ** 2 / 6
    np.testing.assert_allclose(
        fields["body_inertia"][:, env.physics_model.body("cube").id], np.tile(inertia, (3, 1)).T, rtol=1e-5
    )
    np.testing.assert_allclose(fields["geom_rbound"][:, cube], 3**0.5 * 0.015 * factor, rtol=1e-5)
    np.testing.assert_allclose(sim.qpos[:, -5], 0.015 * factor, rtol=1e-5)
    # Shares of 25 N m.
    friction, effort = fields["dof_frictionloss"][:, :7], fields["actuator_forcerange"][:, :7]
    assert 0.5 <= friction[:, 0].min() < 0.55 and 2.4 < friction[:, 0].max() <= 2.5 + 1e-6 and (friction[:, 2] == 0).all()
    assert 0.5 <= effort[:, 1, 1].min() < 0.55 and 2.4 < effort[:, 1, 1].max() <= 2.5 + 1e-6 and (effort[:, 2, 1] == 25).all()
    np.testing.assert_array_equal(effort[..., 0], -effort[..., 1])
    bias = jax.vmap(lambda s: env._viewer._encoder_bias(s))(sim)
    assert 0.048 < np.abs(bias[:, 1]).max() <= 0.05 + 1e-6 and (bias[:, 0] == 0).all()
    np.testing.assert_allclose(fields["actuator_biasprm"][:, 1, 0], -170 * bias[:, 1], rtol=1e-5)


def test_a_cube_of_another_size_meets_the_table_like_one_compiled_so():
    """Dropped from 5 mm, in MuJoCo's C library; the compiled one's density is such that its mass is the same."""
    env = make("nero_lift", impl="native", randomization={"size": REST["size"]})
    field = drawn(env, 8)
    sim = jax.jit(jax.vmap(lambda key: env.sample(key)[0]))(jax.random.split(jax.random.PRNGKey(0), 8))
    sim = sim.replace(fields=field, qpos=sim.qpos.at[:, -5].add(0.005))
    ctrl, edge = sim.ctrl, 2 * float(field["geom_size"][3, env.physics_model.geom("cube").id, 0])
    other = make("nero_lift", impl="native", **{"scene.objects.cube.size": (edge,) * 3})
    alone = jax.tree.map(lambda x: x[3:4], sim.replace(fields={}))
    for _ in range(15):
        sim, alone = env.physics.step(sim, ctrl)[0], other.physics.step(alone, ctrl[3:4])[0]
    np.testing.assert_allclose(sim.qpos[3], alone.qpos[0], rtol=0, atol=1e-5)
    np.testing.assert_allclose(sim.qpos[:, -5], field["geom_size"][:, env.physics_model.geom("cube").id, 0], atol=3e-4)


def test_gravity_compensation_needs_a_robot_that_has_it():
    links = Term(randomization.gravity_compensation, params={"bodies": ("link2",), "scale": (0.8, 1.2)})
    fields = drawn(make("piper_lift", impl="native", randomization={"x": links}), 100)
    share = fields["body_gravcomp"][:, 2]
    assert 0.8 <= share.min() < 0.82 and 1.18 < share.max() <= 1.2 + 1e-6
    with pytest.raises(UserError, match="this robot has no gravity compensation"):
        make("nero_lift", impl="native", randomization={"x": links})
    center = Term(randomization.center_of_mass, params={"bodies": ("cube",), "offset": 0.01})
    with pytest.raises(UserError, match="draws body_ipos of 'cube': its centre of mass"):
        make("nero_lift", impl="native", randomization={"x": center})


def test_gains_change_stiffness_and_damping_of_some_drives():
    env = make("nero_lift", impl="native", randomization={"drives": ARM["drives"]})
    fields = drawn(env, 200)
    for actuator, kp, kd in [(0, 200.0, 100.0), (3, 80.0, 24.0)]:  # joint1 and joint4
        stiffness, bias = fields["actuator_gainprm"][:, actuator, 0], fields["actuator_biasprm"][:, actuator]
        np.testing.assert_allclose(stiffness, -bias[:, 1], rtol=1e-6)
        assert 0.7 <= stiffness.min() / kp < 0.72 and 1.48 < stiffness.max() / kp <= 1.5 + 1e-6
        assert 0.5 <= -bias[:, 2].max() / kd < 0.52 and 1.95 < -bias[:, 2].min() / kd <= 2.0 + 1e-6
    assert (fields["actuator_gainprm"][:, 1, 0] == 170.0).all()


def test_without_terms_there_are_no_fields():
    env = make("nero_lift", impl="native")
    assert jax.eval_shape(env.sample, jax.random.PRNGKey(0))[0].fields == {}


def test_an_episode_keeps_its_fields_and_the_next_draws_anew(env):
    train = wrappers.for_training(env)
    step = jax.jit(train.step)
    start = jax.jit(train.reset)(jax.random.split(jax.random.PRNGKey(1), 8))
    on = step(start, jnp.zeros((8, 8)))
    jax.tree.map(np.testing.assert_array_equal, on.pipeline_state.fields, start.pipeline_state.fields)
    carry = on.info["carry"]
    last = on.replace(info={**on.info, "carry": carry.replace(step=jnp.full(8, env.episode_length - 1))})
    mass = step(last, jnp.zeros((8, 8))).pipeline_state.fields["body_mass"][:, env.physics_model.body("cube").id]
    assert (mass != start.pipeline_state.fields["body_mass"][:, env.physics_model.body("cube").id]).all()


@pytest.mark.parametrize(
    ("term", "message"),
    [
        (Term(randomization.mass, params={"bodies": ("cub",), "scale": (1.0, 2.0)}), "the model has no body 'cub': choose from"),
        (Term(lambda key, model: {"geom_pos": (np.array([0]), 1.0)}), "randomization.x draws geom_pos: only body_mass"),
        (Term(randomization.mass, params={"bodies": ("cube",), "scale": (2.0, 1.0)}), "randomization.x.params.scale is a range"),
        (
            Term(randomization.mass, params={"bodies": ("cube",), "scale": (0.0, 1.0)}),
            "randomization.x.params.scale must be above 0",
        ),
    ],
)
def test_what_cannot_be_drawn_is_refused_when_the_environment_is_made(term, message):
    with pytest.raises(UserError, match=message):
        make("nero_lift", impl="native", randomization={"x": term})


@pytest.fixture(scope="module")
def gripped():
    """Eight states of the shipped policy after three seconds: most cubes are in the air, in the grip. And the targets then."""
    env = make("nero_lift", impl="native", corruption=False)
    trained = policy.load_for(env, "nero_lift", None)
    step = jax.jit(jax.vmap(env.step))
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 8))
    for _ in range(149):
        state = step(state, trained.act(state.obs))
    sim = state.pipeline_state
    assert (sim.qpos[:, 11] > 0.05).sum() >= 4
    return env.physics, sim, jax.jit(jax.vmap(env.targets))(state, trained.act(state.obs))


@pytest.mark.slow
def test_warp_gives_the_same_physics_to_drawn_worlds(worlds, gripped):
    """Tolerances as in test_newton."""
    pytest.importorskip("warp")
    from mjx_nero.sim.physics.warp.mujoco_warp import WarpPhysics

    plain, sim, ctrl = gripped
    sim = sim.replace(fields=drawn(worlds, 8))
    reference, undrawn = worlds.physics.step(sim, ctrl)[0], plain.step(sim, ctrl)[0]
    # The drawn fields matter: by more than the tolerances below.
    assert (np.abs(reference.qvel[:, :12] - undrawn.qvel[:, :12]).max(axis=1) > 4e-3).sum() >= 4
    physics = WarpPhysics(worlds.physics_model, worlds.cfg.sim, worlds._randomization.names)
    ours, lost = jax.jit(jax.vmap(physics.step))(sim, ctrl)
    assert not lost.any()
    for rows, pos, speed in ((slice(0, 12), 1e-5, 2e-3), (slice(12, None), 5e-4, 0.05)):
        np.testing.assert_allclose(ours.qpos[:, rows], reference.qpos[:, rows], rtol=0, atol=pos)
        np.testing.assert_allclose(ours.qvel[:, rows], reference.qvel[:, rows], rtol=0, atol=speed)
    jax.tree.map(np.testing.assert_array_equal, ours.fields, sim.fields)


@pytest.mark.slow
def test_mjx_gives_the_same_physics_to_drawn_worlds(env, gripped):
    """As to a model compiled with what was drawn, and as MuJoCo's C library within the 1 mm (cubes) and 5 mm (fingers) that
    test_physics holds plain worlds to."""
    plain, sim, ctrl = gripped
    sim, model = sim.replace(fields=drawn(env, 8)), copy.copy(env.physics_model)
    step = jax.jit(jax.vmap(JaxPhysics(env.physics_model, env.cfg.sim, env._randomization.names).step))  # compiled once
    ours, _ = step(sim, ctrl)
    reference = env.physics.step(sim, ctrl)[0]
    for rows, atol in ((slice(0, 7), 1e-4), (slice(7, 9), 5e-3), (slice(9, 12), 1e-3)):
        np.testing.assert_allclose(ours.qpos[:, rows], reference.qpos[:, rows], rtol=0, atol=atol)
    jax.tree.map(np.testing.assert_array_equal, ours.fields, sim.fields)

    heaviest = int(np.argmax(sim.fields["body_mass"][:, model.body("cube").id]))
    for name in ("body_mass", "body_inertia", "geom_friction"):
        getattr(model, name)[:] = sim.fields[name][heaviest]
    mujoco.mj_setConst(model, mujoco.MjData(model))
    same = jax.tree.map(lambda x: jnp.stack([x[heaviest]] * 8), (sim.replace(fields={}), ctrl))  # as many, computed alike
    nominal = {name: jnp.stack([jnp.asarray(getattr(env.physics_model, name), jnp.float32)] * 8) for name in sim.fields}
    found = jax.jit(jax.vmap(JaxPhysics(model, env.cfg.sim).step))(*same)[0], step(sim.replace(fields=nominal), ctrl)[0]
    compiled, undrawn = (jax.tree.map(lambda x: x[heaviest], each) for each in found)
    np.testing.assert_allclose(ours.qpos[heaviest], compiled.qpos, rtol=0, atol=2e-6)
    np.testing.assert_allclose(ours.qvel[heaviest], compiled.qvel, rtol=0, atol=1e-3)
    assert np.abs(undrawn.qvel - compiled.qvel).max() > 0.01
