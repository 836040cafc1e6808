"""Fixtures: where they stand, what their joints do, the same on all backends; and files that are none."""

import math
import pathlib
import re

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import slides

from mjx_nero import UserError
from mjx_nero.sim import fixtures, scene
from mjx_nero.sim.fixtures import FIELDS, FixtureCfg, Fixtures
from mjx_nero.sim.physics.mjx import JaxPhysics
from mjx_nero.sim.physics.native import NativePhysics
from mjx_nero.sim.scene import SceneCfg, SimCfg
from mjx_nero.types import FixtureStart, Sim, Start

# A ball on a slide along x, which pushes what stands in its way.
PUSHER = '<geom name="ball" size="0.05" mass="1" contype="0" conaffinity="2"/><site name="ee"/>'
ROBOT = slides.robot("ball", "x", PUSHER, 400.0, 40.0, 100.0)
# A sled of 2 kg on a slide along the fixture's y with 4 N of friction, and a flap at its end. Nothing else moves them.
SLED = """
<mujoco>
  <compiler angle="degree"/>
  <worldbody>
    <body name="rail" pos="0 0 0.5">
      <geom type="box" size="0.02 0.5 0.02" pos="0 0 -0.2" mass="1"/>
      <body name="sled">
        <joint name="sled" type="slide" axis="0 1 0" range="-0.3 0.3" frictionloss="4"/>
        <geom name="sled" type="box" size="0.1 0.1 0.1" mass="2"/>
        <site name="front" pos="0 0.1 0" quat="1 0 0 1"/>
        <body name="flap" pos="0 0.2 0">
          <joint name="flap" axis="0 0 1" range="-90 90"/>
          <geom type="box" size="0.01 0.05 0.05" pos="0 0.05 0" mass="0.01" contype="0" conaffinity="0"/>
          <site name="tip" pos="0 0.1 0"/>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
CFG = SimCfg(dt=0.005, decimation=4, iterations=30)


@pytest.fixture(scope="module")
def where(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sled")
    (folder / "model.xml").write_text(SLED)
    return SceneCfg(objects={}, table=False, goal="none", fixtures={"sled": FixtureCfg(str(folder), pos=(2.0, 0.0, 0.0))})


@pytest.fixture(scope="module")
def model(where) -> mujoco.MjModel:
    return scene.build(ROBOT, where, CFG, visuals=False, fuse=True)


def stands(x, y, degrees, sled=0.0, flap=0.0) -> Start:
    half = math.radians(degrees) / 2
    joints = {"sled": jnp.array(sled), "flap": jnp.array(flap)}
    quat = jnp.array([math.cos(half), 0.0, 0.0, math.sin(half)])
    return Start(jnp.zeros(1), {}, {}, fixtures={"sled": FixtureStart(jnp.array([x, y, 0.0]), quat, joints)})


def test_joints_sites_and_contacts_of_the_file(model):
    joints = [model.joint(i).name for i in range(model.njnt)]
    assert joints == ["x", "sled/sled", "sled/flap"]
    np.testing.assert_allclose(model.joint("sled/flap").range, [-math.pi / 2, math.pi / 2])  # degrees are the file's own
    # What collides meets hands (2) and objects (4), and never its like; what does not collide is only drawn.
    ours = [g for g in range(model.ngeom) if model.body(model.geom_bodyid[g]).name.startswith("sled/")]
    assert {(int(model.geom_contype[g]), int(model.geom_conaffinity[g])) for g in ours} == {(6, 0)}
    assert model.body("sled/flap").mass[0] == pytest.approx(0.01)


def test_a_view_is_where_mujoco_has_it(model, where):
    """Turned by a quarter at (1, 2): 10 cm out along its y, which is the world's -x; the flap at 30 degrees."""
    found = Fixtures(model, where.fixtures)
    start = stands(1.0, 2.0, 90, sled=0.1, flap=math.radians(30))
    fields = found.given(start)
    qpos = found.qpos(jnp.zeros(3), start, fields)
    np.testing.assert_allclose(qpos, [0.0, 0.1, math.radians(30)], atol=1e-6)
    sim = Sim(qpos, jnp.array([0.0, 0.5, -1.0]), jnp.zeros(1), jnp.zeros(3), jnp.zeros(()), fields)
    seen = found.view(sim, None)["fixtures"]["sled"]
    assert float(seen.joint_pos["sled"]) == pytest.approx(0.1) and float(seen.joint_vel["flap"]) == -1.0
    np.testing.assert_allclose(seen.joint_range["sled"], [-0.3, 0.3], atol=1e-6)
    np.testing.assert_allclose(seen.site_pos_w["front"], [0.8, 2.0, 0.5], atol=1e-6)
    tip = [1 - 0.3 - 0.1 * math.cos(math.radians(30)), 2 - 0.1 * math.sin(math.radians(30)), 0.5]
    np.testing.assert_allclose(seen.site_pos_w["tip"], tip, atol=1e-6)
    np.testing.assert_allclose(np.abs(seen.site_quat_w["front"]), [0, 0, 0, 1], atol=1e-6)  # a quarter more: half a turn
    for field in FIELDS:
        getattr(model, field)[:] = fields[field]
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    for site in ("front", "tip"):
        np.testing.assert_allclose(seen.site_pos_w[site], data.site(f"sled/{site}").xpos, atol=1e-6)


def test_starts_keep_to_the_joints_ranges(model, where):
    found = Fixtures(model, where.fixtures)
    start = stands(0, 0, 0, sled=1.0, flap=-3.0)
    np.testing.assert_allclose(found.qpos(jnp.zeros(3), start, {})[1:], [0.3, -math.pi / 2], atol=1e-6)
    narrow = {"jnt_range": jnp.array([[-1, 1], [-0.1, 0.2], [-1, 1]], jnp.float32)}
    np.testing.assert_allclose(found.qpos(jnp.zeros(3), start, narrow)[1:], [0.2, -1.0], atol=1e-6)


def play(physics, found, steps=10) -> Sim:
    """Three worlds: the sled slides freely at 1 m/s; the ball runs into it, its rail along the way; the sled stands aside."""
    starts = [stands(2.0, 0.0, 0), stands(0.4, 0.0, -90), stands(0.4, 2.0, -90)]
    fields = [found.given(start) for start in starts]
    qpos = jnp.stack([found.qpos(jnp.zeros(3), s, f) for s, f in zip(starts, fields, strict=True)])
    qvel = jnp.zeros((3, 3)).at[0, 1].set(1.0)
    ctrl = jnp.array([[0.0], [0.5], [0.5]])
    zero = jnp.zeros((3, 3))
    sim = Sim(qpos, qvel, ctrl, zero, jnp.zeros(3), fields=jax.tree.map(lambda *x: jnp.stack(x), *fields))
    step = jax.jit(jax.vmap(physics.step))
    for _ in range(steps):
        sim, lost = step(sim, ctrl)
        assert not np.any(lost)
    return sim


def _check(sim):
    """After 0.2 s: 4 N have taken 0.4 m/s from 2 kg, on the way 0.16 m; pushed, the sled moves to where the ball is, 15 cm off
    its middle; nobody touches the third."""
    np.testing.assert_allclose(sim.qvel[0, 1], 0.6, atol=0.01)
    np.testing.assert_allclose(sim.qpos[0, 1], 0.16, atol=0.005)
    assert sim.qpos[1, 1] > 0.003
    np.testing.assert_allclose(sim.qpos[1, 0] + 0.15, 0.4 + sim.qpos[1, 1], atol=0.005)
    assert sim.qpos[2, 0] > sim.qpos[1, 0] + 0.01 and abs(sim.qpos[2, 1]) < 1e-4


def test_a_fixture_moves_where_it_stands(model, where):
    _check(play(NativePhysics(model, CFG, FIELDS), Fixtures(model, where.fixtures)))


@pytest.mark.slow
def test_a_fixture_moves_alike_on_mjx(model, where):
    _check(play(JaxPhysics(model, CFG, FIELDS), Fixtures(model, where.fixtures)))


@pytest.mark.slow
@pytest.mark.parametrize("solver", ["newton", "mujoco_warp"])
def test_a_fixture_moves_alike_on_warp(model, where, solver):
    pytest.importorskip("warp")
    from mjx_nero.sim.physics.warp import dynamics
    from mjx_nero.sim.physics.warp.mujoco_warp import WarpPhysics

    assert dynamics.missing(model) == []
    cfg = SimCfg(dt=CFG.dt, decimation=CFG.decimation, iterations=30, solver=solver)
    _check(play(WarpPhysics(model, cfg, FIELDS), Fixtures(model, where.fixtures)))


def test_our_own_have_what_their_comments_say():
    assert fixtures.own() == ("cabinet", "knob", "socket_round", "socket_square", "stand")
    cabinet, knob = fixtures.chain("cabinet"), fixtures.chain("knob")
    assert cabinet.joints == ("drawer", "door") and knob.joints == ("knob",)
    pos, quat = cabinet.poses(jnp.array([0.1, math.pi / 2]))
    np.testing.assert_allclose(pos[0], [-0.145, 0.108, 0.3], atol=1e-6)  # pulled out towards -x
    # The bar, 175 mm from the hinge and 51 mm in front of it, a quarter turn to the left.
    np.testing.assert_allclose(pos[1], [0.006 - 0.175, -0.21 - 0.051, 0.3], atol=1e-5)
    turns = np.zeros((2, 9))
    for turn, q in zip(turns, quat, strict=True):
        mujoco.mju_quat2Mat(turn, np.array(q, float))
    np.testing.assert_allclose(turns[0].reshape(3, 3)[:, [0, 2]].T, [[1, 0, 0], [0, 1, 0]], atol=1e-6)  # into it; along the bar
    np.testing.assert_allclose(turns[1].reshape(3, 3)[:, [0, 2]].T, [[0, 1, 0], [0, 0, 1]], atol=1e-6)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "no fixture .*: choose one of cabinet, knob, .*, or give a folder with model.xml"),
        ("<mujoco><worldbody><body/></worldbody></mujoco>", "has no joint that moves, and no site"),
        (
            "<mujoco><worldbody><body name='a'><joint/><geom size='1'/></body></worldbody></mujoco>",
            "a joint of body 'a' has no name: give it one",
        ),
        ("<mujoco><worldbody><body><joint name='a' type='ball'/></body></worldbody></mujoco>", "choose from hinge, slide"),
        ("<mujoco><include file='/etc/passwd'/></mujoco>", "<include> is not allowed"),
        ("<mujoco><worldbody><body><joint name='a'/></body></worldbody></mujoco>", "is not a valid model: .*mass"),
    ],
)
def test_bad_files_get_a_line(tmp_path, text, message):
    if text:
        (tmp_path / "model.xml").write_text(text)
    with pytest.raises(UserError, match=message) as error:
        fixtures.chain(str(tmp_path))
    assert "\n" not in str(error.value).strip()


@pytest.mark.parametrize("name", ["goal", "a/b", "base_link"])
def test_a_name_that_is_taken_is_refused(name):
    with pytest.raises(UserError, match="needs another name"):
        scene.build(ROBOT, SceneCfg(objects={}, fixtures={name: FixtureCfg("knob")}), CFG, visuals=False)


def test_the_guides_scenes():
    """The Python of docs/guides/fixtures.md: a cabinet in another task, and a wrist that feels."""
    page = pathlib.Path(__file__).parents[2] / "docs" / "guides" / "fixtures.md"
    cabinet, wrist = re.findall(r"^```python\n(.*?)^```", page.read_text(), re.MULTILINE | re.DOTALL)
    names: dict = {}
    exec(cabinet, names)
    state = names["env"].reset(jax.random.PRNGKey(0))
    assert set(names["env"].view(state).fixtures) == {"box"}
    exec(wrist, names)
    felt = names["env"].named_observations(names["env"].reset(jax.random.PRNGKey(0)))["state"]["wrist"]
    assert felt.shape == (6,) and jnp.isfinite(felt).all()
