"""Forward kinematics in JAX against MuJoCo's."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjx_nero import kinematics

# Turned and shifted bodies; a slide and a hinge with an anchor off the body's origin in one body, two more hinges in another.
CHAIN = """
<mujoco>
  <worldbody>
    <body pos="0.1 -0.2 0.3" quat="0.9 0.1 -0.3 0.2">
      <joint name="slide" type="slide" axis="0.6 0 0.8"/>
      <joint name="offset" type="hinge" axis="0 0.6 0.8" pos="0.3 -0.1 0.2"/>
      <geom size="0.1"/>
      <body pos="0.4 0 0.1" quat="0.5 0.5 -0.5 0.5">
        <joint name="a" type="hinge" axis="1 0 0" pos="0 0.2 0"/>
        <joint name="b" type="hinge" axis="0 0 1" pos="0.1 0 -0.3"/>
        <geom size="0.1"/>
        <body pos="0 0 0.2">
          <geom size="0.1"/>
          <site name="tip" pos="0.05 0.06 0.07" quat="0.8 0 0.6 0"/>
        </body>
      </body>
    </body>
    <body name="loose"><freejoint/><geom size="0.1"/><site name="floating"/></body>
    <body name="ball"><joint type="ball"/><geom size="0.1"/><site name="swinging"/></body>
    <site name="fixed" pos="1 2 3" quat="0 1 0 0"/>
  </worldbody>
</mujoco>
"""


def agrees(model: mujoco.MjModel, site: str, qpos: np.ndarray) -> None:
    pose = jax.jit(kinematics.site_pose_fn(model, site))
    data, quat = mujoco.MjData(model), np.empty(4)
    for q in qpos:
        data.qpos[:] = q
        mujoco.mj_forward(model, data)
        mujoco.mju_mat2Quat(quat, data.site(site).xmat)
        pos, turn = (np.asarray(x) for x in pose(jnp.asarray(q, jnp.float32)))
        np.testing.assert_allclose(pos, data.site(site).xpos, rtol=0, atol=1e-5)
        np.testing.assert_allclose(turn * np.sign(turn @ quat), quat, rtol=0, atol=1e-5)  # q and -q are one rotation


def test_slides_and_hinges_with_anchors():
    model = mujoco.MjModel.from_xml_string(CHAIN)
    qpos = np.random.default_rng(0).uniform(-3, 3, (50, model.nq))
    agrees(model, "tip", qpos)


def test_site_of_the_world():
    pos, quat = kinematics.site_pose_fn(mujoco.MjModel.from_xml_string(CHAIN), "fixed")(jnp.zeros(15))
    np.testing.assert_array_equal(pos, [1, 2, 3])
    np.testing.assert_array_equal(quat, [0, 1, 0, 0])


def test_grasp_point_of_the_robot(env):
    model = env.physics_model
    qpos = np.tile(model.qpos0, (100, 1))
    hinges = model.jnt_qposadr[: model.njnt - 1]
    qpos[:, hinges] = np.random.default_rng(1).uniform(*model.jnt_range[: model.njnt - 1].T, (100, len(hinges)))
    agrees(model, "ee", qpos)


def test_half_a_turn_at_the_base_puts_the_grasp_point_over_the_table(env):
    data = mujoco.MjData(env.physics_model)
    qpos = jnp.asarray(data.qpos, jnp.float32).at[:9].set(jnp.array(env.cfg.robot.home))
    pos, _ = kinematics.site_pose_fn(env.physics_model, "ee")(qpos)
    (x, y, z) = (float(v) for v in pos)
    assert 0.3 < x < 0.4 and abs(y) < 1e-4 and 0.2 < z < 0.3  # over the recipe's cubes, at +x


@pytest.mark.parametrize("site", ["floating", "swinging"])
def test_free_and_ball_joints_are_refused(site):
    with pytest.raises(ValueError, match=f"site '{site}' hangs on a ball or free joint: only hinges and slides"):
        kinematics.site_pose_fn(mujoco.MjModel.from_xml_string(CHAIN), site)


def test_unknown_site_is_named():
    with pytest.raises(KeyError, match="Invalid name 'nowhere'"):
        kinematics.site_pose_fn(mujoco.MjModel.from_xml_string(CHAIN), "nowhere")
