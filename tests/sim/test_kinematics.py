"""Forward kinematics and Jacobians in JAX against MuJoCo's."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjx_nero.sim import kinematics, linkage
from mjx_nero.sim.kinematics import Chain
from mjx_nero.sim.scene import robot_model
from mjx_nero.tasks.arms.cobotta_pro_900 import COBOTTA_PRO_900
from mjx_nero.tasks.arms.nero import NERO

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
        <body name="hand" pos="0 0 0.2" quat="0 0.6 0.8 0">
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
    with pytest.raises(ValueError, match=f"frame '{site}' hangs on a ball or free joint: only hinges and slides"):
        kinematics.site_pose_fn(mujoco.MjModel.from_xml_string(CHAIN), site)


def test_unknown_site_is_named():
    with pytest.raises(KeyError, match="Invalid name 'nowhere'"):
        kinematics.site_pose_fn(mujoco.MjModel.from_xml_string(CHAIN), "nowhere")


# --- chains

SLIDE, OFFSET, A, B = ORDER = ("slide", "offset", "a", "b")


def mujocos(model: mujoco.MjModel, joints, frames, q):
    """Positions, orientations and Jacobians of sites or bodies with ``joints`` at ``q``, what follows them where it belongs, and
    the others at ``qpos0``."""
    data, pos, quat, jac = mujoco.MjData(model), [], [], []
    for joint, value in zip(joints, q, strict=True):
        data.joint(joint).qpos = value
    moves = np.zeros((model.nv, len(joints)))  # of each degree of freedom, a unit of each listed joint
    moves[[model.joint(j).dofadr[0] for j in joints], np.arange(len(joints))] = 1
    dof = {int(address): int(d) for address, d in zip(model.jnt_qposadr, model.jnt_dofadr, strict=True)}
    for each in linkage.couplings(model):  # leaders come before their followers
        if moves[dof[each.leader]].any() and not moves[dof[each.follower]].any():
            slope = np.polynomial.Polynomial(each.coefficients).deriv()(data.qpos[each.leader] - each.reference)
            data.qpos[each.follower] = each.position(data.qpos)
            moves[dof[each.follower]] = slope * moves[dof[each.leader]]
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    for frame in frames:
        linear, angular, turn = np.zeros((3, model.nv)), np.zeros((3, model.nv)), np.zeros(4)
        site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, frame)
        if site >= 0:
            mujoco.mj_jacSite(model, data, linear, angular, site)
            at = data.site(site)
        else:
            mujoco.mj_jacBody(model, data, linear, angular, model.body(frame).id)
            at = data.body(frame)
        mujoco.mju_mat2Quat(turn, at.xmat)
        pos.append(at.xpos.copy())
        quat.append(turn)
        jac.append(np.concatenate([linear, angular]) @ moves)
    return np.array(pos), np.array(quat), np.array(jac)


def chain_agrees(model: mujoco.MjModel, joints, frames, qs) -> None:
    chain = Chain(model, joints, frames)
    assert chain.joints == tuple(joints) and chain.frames == tuple(frames)
    poses, jacobians = jax.jit(chain.poses), jax.jit(chain.jacobians)
    for q in qs:
        pos, quat, jac = mujocos(model, joints, frames, q)
        got = jacobians(jnp.asarray(q, jnp.float32))
        for at, turn in (poses(jnp.asarray(q, jnp.float32)), got[:2]):
            np.testing.assert_allclose(at, pos, rtol=0, atol=2e-6 * (1 + np.abs(pos).max()))
            turn = np.asarray(turn)
            np.testing.assert_allclose(turn * np.sign(np.sum(turn * quat, axis=1, keepdims=True)), quat, rtol=0, atol=1e-5)
        np.testing.assert_allclose(got[2], jac, rtol=0, atol=1e-5)


@pytest.mark.parametrize(
    "joints",
    [ORDER, (B, A, OFFSET, SLIDE), (A,), (SLIDE,), (B, SLIDE), (OFFSET, A)],
    ids=lambda joints: " ".join(joints),
)
def test_chain_of_several_frames(joints):
    model = mujoco.MjModel.from_xml_string(CHAIN)
    qs = np.random.default_rng(3).uniform(-3, 3, (20, len(joints)))
    chain_agrees(model, joints, ("tip", "hand", "fixed", "tip"), qs)


def test_joints_that_are_not_listed_stay_at_qpos0():
    xml = CHAIN.replace('name="offset"', 'ref="40" name="offset"').replace('name="slide"', 'ref="-0.2" name="slide"')
    model = mujoco.MjModel.from_xml_string(xml)
    assert model.joint(SLIDE).qpos0[0] == -0.2 and model.joint(OFFSET).qpos0[0] > 0.6
    free = Chain(model, (A, B), ("tip",)).poses(jnp.array([0.3, -0.7]))
    # at its qpos0 a joint displaces nothing: as in the model whose qpos0 is zero
    plain = Chain(mujoco.MjModel.from_xml_string(CHAIN), ORDER, ("tip",)).poses(jnp.array([0.0, 0.0, 0.3, -0.7]))
    for x, y in zip(free, plain, strict=True):
        np.testing.assert_allclose(x, y, atol=1e-6)
    chain_agrees(model, (A, B), ("tip",), np.random.default_rng(4).uniform(-3, 3, (5, 2)))


def test_joints_that_follow_a_listed_one_move_with_it():
    """As in the parallelograms of palletising arms: a joint follows one with a ratio, another follows that."""
    equality = """<equality>
      <joint joint1="offset" joint2="slide" polycoef="0.2 -1.5 0.3 0 0"/>
      <joint joint1="b" joint2="offset" polycoef="0.1 2 0 0 0"/>
    </equality></mujoco>"""
    xml = CHAIN.replace('name="offset"', 'ref="40" name="offset"').replace('name="slide"', 'ref="-0.2" name="slide"')
    model = mujoco.MjModel.from_xml_string(xml.replace("</mujoco>", equality))
    start = model.joint(OFFSET).qpos0[0]
    chain = Chain(model, (A, SLIDE), ("tip", "hand"))
    for q in np.random.default_rng(5).uniform(-0.5, 0.5, (5, 2)):
        moved = 0.2 - 1.5 * (q[1] + 0.2) + 0.3 * (q[1] + 0.2) ** 2
        pos, quat, jac = mujocos(model, ORDER, ("tip", "hand"), [q[1], start + moved, q[0], 0.1 + 2 * moved])
        slope = -1.5 + 0.6 * (q[1] + 0.2)
        wanted = np.stack([jac[:, :, 2], jac[:, :, 0] + slope * jac[:, :, 1] + 2 * slope * jac[:, :, 3]], axis=2)
        at, turn, got = chain.jacobians(jnp.asarray(q, jnp.float32))
        np.testing.assert_allclose(at, pos, atol=1e-5)
        np.testing.assert_allclose(np.abs(np.sum(np.asarray(turn) * quat, axis=1)), 1, atol=1e-5)
        np.testing.assert_allclose(got, wanted, atol=2e-5)


@pytest.mark.parametrize("robot", [NERO, COBOTTA_PRO_900], ids=lambda robot: robot.name)
def test_chain_of_the_robots(robot):
    model = robot_model(robot)
    ids = [model.joint(j).id for j in robot.joints]
    qs = np.random.default_rng(6).uniform(*model.jnt_range[ids].T, (30, len(ids)))
    last = model.body(model.nbody - 1).name
    chain_agrees(model, robot.joints, (robot.ee_site, last, robot.base_link), qs)
    chain = Chain(model, robot.arm.joints[::-1], (robot.ee_site,))
    np.testing.assert_allclose(chain.lower, model.jnt_range[ids[: len(robot.arm.joints)], 0][::-1], rtol=1e-6)
    np.testing.assert_allclose(chain.upper, model.jnt_range[ids[: len(robot.arm.joints)], 1][::-1], rtol=1e-6)


def test_limits_are_infinite_where_there_are_none():
    xml = CHAIN.replace('name="a"', 'name="a" range="-1 2" limited="true"').replace(
        "<mujoco>", '<mujoco><compiler angle="radian"/>'
    )
    chain = Chain(mujoco.MjModel.from_xml_string(xml), (B, A), ("tip",))
    np.testing.assert_array_equal(chain.lower, [-np.inf, -1])
    np.testing.assert_array_equal(chain.upper, [np.inf, 2])


def test_jacobian_is_the_derivative_of_the_position():
    model = mujoco.MjModel.from_xml_string(CHAIN)
    chain, q = Chain(model, ORDER, ("tip", "hand")), jnp.array([0.2, -0.5, 1.1, 0.7])
    np.testing.assert_allclose(chain.jacobians(q)[2][:, :3], jax.jacobian(lambda q: chain.poses(q)[0])(q), atol=1e-5)


@pytest.mark.parametrize(
    ("joints", "frames", "error", "message"),
    [
        (("elbow",), ("tip",), KeyError, "Invalid name 'elbow'"),
        (ORDER, ("nowhere",), KeyError, "Invalid name 'nowhere'"),
        (("swivel",), ("tip",), ValueError, "joint 'swivel' is a ball or free joint: only hinges and slides are supported"),
        (ORDER, ("tip", "floating"), ValueError, "frame 'floating' hangs on a ball or free joint"),
        (ORDER, ("loose",), ValueError, "frame 'loose' hangs on a ball or free joint"),
    ],
)
def test_what_a_chain_refuses(joints, frames, error, message):
    model = mujoco.MjModel.from_xml_string(CHAIN.replace('<joint type="ball"/>', '<joint name="swivel" type="ball"/>'))
    with pytest.raises(error, match=message):
        Chain(model, joints, frames)


def test_joint_with_a_reference_position():
    xml = """<mujoco><worldbody><body><joint name="a" axis="0 0 1" ref="0.5"/><geom size="0.1"/>
    <site name="tip" pos="1 0 0"/></body></worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml.replace("<worldbody>", "<compiler angle='radian'/><worldbody>"))
    pos, _ = kinematics.Chain(model, ["a"], ["tip"]).poses(jnp.array([0.5 + np.pi / 2]))
    np.testing.assert_allclose(pos[0], [0, 1, 0], atol=1e-6)


def test_poses_are_computed_once_in_a_program_of_several_steps():
    """Without barriers XLA fuses links into whatever reads them, and computes the sines of each joint nine times."""
    chain, envs, steps = Chain(robot_model(NERO), NERO.arm.joints, (NERO.ee_site,)), 64, 3

    def descend(q):
        for _ in range(steps):
            pos, quat, jacobian = chain.jacobians(q)
            q = q + jacobian[0].T @ jnp.concatenate([pos[0], quat[0, :3]])
        return q

    q = jnp.zeros((envs, len(chain.joints)))
    cost = jax.jit(jax.vmap(descend)).lower(q).compile().cost_analysis()
    assert cost["transcendentals"] < 5 * envs * steps * 2 * len(chain.joints)
