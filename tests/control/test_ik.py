"""Jacobians and inverse kinematics against MuJoCo's kinematics in double precision, and against a closed form."""

import functools
import sys

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from model_checks import cobotta_down

from mjx_nero import math
from mjx_nero.control import ik
from mjx_nero.sim import scene
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.tasks.arms.cobotta_pro_900 import COBOTTA_PRO_900
from mjx_nero.tasks.arms.nero import NERO
from mjx_nero.tasks.arms.so_arm100 import SO_ARM100
from mjx_nero.tools.benchmark import inverse_kinematics

N = 500  # every test of the batched solver has this batch: it is compiled once a robot


class Arm:
    """A robot, its solver, compiled, and MuJoCo's kinematics of it."""

    def __init__(self, robot: RobotCfg):
        self.robot, self.model = robot, scene.robot_model(robot)
        self.data = mujoco.MjData(self.model)
        self.site = self.model.site(robot.ee_site).id
        self.qpos = [self.model.joint(j).qposadr[0] for j in robot.arm.joints]
        self.dofs = [self.model.joint(j).dofadr[0] for j in robot.arm.joints]
        self.lower, self.upper = (self.model.jnt_range[[self.model.joint(j).id for j in robot.arm.joints]]).T
        self.solver = ik.InverseKinematics(robot)
        self.solve = jax.jit(self.solver.solve_batch)
        self.local = jax.jit(jax.vmap(self.solver.local))
        self.home = jnp.tile(jnp.array(robot.arm.home), (N, 1))

    def random(self, seed: int, n: int = N) -> np.ndarray:
        return np.random.default_rng(seed).uniform(self.lower, self.upper, (n, len(self.lower)))

    def pose(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Position and orientation of the grasp point, by MuJoCo."""
        self.data.qpos[self.qpos] = q
        mujoco.mj_kinematics(self.model, self.data)
        quat = np.empty(4)
        mujoco.mju_mat2Quat(quat, self.data.site_xmat[self.site])
        return self.data.site_xpos[self.site].copy(), quat

    def poses(self, q: np.ndarray) -> tuple[jax.Array, jax.Array]:
        pos, quat = zip(*(self.pose(x) for x in q), strict=True)
        return jnp.array(np.array(pos), jnp.float32), jnp.array(np.array(quat), jnp.float32)

    def errors(self, q, pos, quat) -> np.ndarray:
        """Distance [m] and angle [rad] between the poses at ``q`` and the targets."""
        result = []
        for x, p, r in zip(*(np.asarray(a, float) for a in (q, pos, quat)), strict=True):
            at, turn = self.pose(x)
            result.append((np.linalg.norm(at - p), np.linalg.norm(difference(turn, r / np.linalg.norm(r)))))
        return np.array(result)


def difference(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The rotation vector, in the frame of ``a``, from ``a`` to ``b``."""
    result = np.empty(3)
    mujoco.mju_subQuat(result, b, a)
    return result


@pytest.fixture(scope="module", params=[NERO, COBOTTA_PRO_900], ids=lambda robot: robot.name)
def arm(request) -> Arm:
    return Arm(request.param)


def test_jacobian_against_mujoco(arm):
    q = arm.random(0, 50)
    _, _, jacobians = jax.jit(jax.vmap(arm.solver.chain.jacobians))(jnp.array(q, jnp.float32))
    for x, jacobian in zip(q, np.asarray(jacobians)[:, 0], strict=True):
        arm.data.qpos[arm.qpos] = x
        mujoco.mj_kinematics(arm.model, arm.data)
        mujoco.mj_comPos(arm.model, arm.data)
        linear, angular = np.empty((3, arm.model.nv)), np.empty((3, arm.model.nv))
        mujoco.mj_jacSite(arm.model, arm.data, linear, angular, arm.site)
        np.testing.assert_allclose(jacobian, np.concatenate([linear, angular])[:, arm.dofs], rtol=0, atol=1e-5)


def test_jacobian_against_finite_differences(arm):
    q, h = arm.random(1, 50), 1e-6
    _, _, jacobians = jax.jit(jax.vmap(arm.solver.chain.jacobians))(jnp.array(q, jnp.float32))
    for x, jacobian in zip(q, np.asarray(jacobians)[:, 0], strict=True):
        for i, unit in enumerate(np.eye(len(x))):
            (p0, r0), (p1, r1) = arm.pose(x - h * unit), arm.pose(x + h * unit)
            turn = np.empty(3)
            mujoco.mju_rotVecQuat(turn, difference(r0, r1), r0)  # into the world
            np.testing.assert_allclose(jacobian[:, i], np.concatenate([p1 - p0, turn]) / (2 * h), rtol=0, atol=1e-5)


def test_ten_thousand_reachable_poses(arm):
    """At least 99% from the home position; limits kept; the flags and errors are those of MuJoCo's kinematics."""
    solved, total = 0, 10_000
    for seed in range(total // N):
        pos, quat = arm.poses(arm.random(100 + seed))
        found = arm.solve(pos, quat, arm.home, jax.random.PRNGKey(seed))
        q, success = np.asarray(found.q, float), np.asarray(found.success)
        assert np.all(q >= arm.lower - 1e-6) and np.all(q <= arm.upper + 1e-6)
        errors = arm.errors(q, pos, quat)
        assert np.all(errors[success] <= [1e-3 + 2e-6, 1e-2 + 2e-6])
        assert np.all(np.any(errors[~success] > [1e-3 - 2e-6, 1e-2 - 2e-6], axis=1))
        np.testing.assert_allclose(np.stack([found.position_error, found.orientation_error], 1), errors, rtol=1e-4, atol=5e-6)
        # No joint is a whole turn further from the warm start than it needs to be.
        turned = q - 2 * np.pi * np.round((q - np.asarray(arm.home)) / (2 * np.pi))
        assert np.all((np.abs(turned - q) < 1e-6) | (turned < arm.lower) | (turned > arm.upper))
        solved += success.sum()
    assert solved >= 0.99 * total


def test_hopeless_targets(arm):
    """Out of reach, not finite, no rotation: no success, and joints within the limits beside solved neighbours."""
    pos, quat = arm.poses(arm.random(2))
    pos = pos.at[:3].set(jnp.array([[2.0, 0, 0], [0, 0, 1e30], [-1e38, 1e38, 0]]))
    pos = pos.at[3].set(jnp.nan).at[4, 1].set(jnp.inf)
    quat = quat.at[5].set(jnp.nan).at[6].set(0.0)
    found = arm.solve(pos, quat, arm.home, jax.random.PRNGKey(0))
    assert not np.any(found.success[:7]) and np.mean(found.success[7:]) >= 0.99
    assert (
        np.all(np.isfinite(found.q))
        and not np.any(np.isnan(found.position_error))
        and not np.any(np.isnan(found.orientation_error))
    )
    assert np.all(found.q >= arm.solver.chain.lower) and np.all(found.q <= arm.solver.chain.upper)
    np.testing.assert_array_equal(found.q[3:7], arm.home[3:7])
    assert np.all(np.isinf(found.position_error[3:7]))
    # What is out of reach is approached: the arm is stretched towards x = 2.
    assert arm.pose(np.asarray(found.q[0], float))[0][0] > arm.pose(np.asarray(arm.home[0], float))[0][0] + 0.1


def test_warm_start_that_is_no_configuration(arm):
    pos, quat = arm.poses(arm.random(3))
    q0 = arm.home.at[0].set(100.0).at[1].set(jnp.nan).at[2].set(-jnp.inf)
    found = arm.solve(pos, quat, q0, jax.random.PRNGKey(0))
    assert np.mean(found.success) >= 0.99 and np.all(found.success[:3])
    assert np.all(found.q >= arm.solver.chain.lower) and np.all(found.q <= arm.solver.chain.upper)


def test_quaternions_of_either_sign_and_any_length(arm):
    pos, quat = arm.poses(arm.random(4))
    one, other = (arm.solve(pos, r, arm.home, jax.random.PRNGKey(0)) for r in (quat, -2.0 * quat))
    np.testing.assert_array_equal(one.success, other.success)
    assert np.mean(np.all(np.abs(one.q - other.q) < 1e-3, axis=1)) > 0.9  # rounding may tip a descent from afar


def test_the_result_is_a_function_of_the_key(arm):
    pos, quat = arm.poses(arm.random(5))
    one, same, other = (arm.solve(pos, quat, arm.home, jax.random.PRNGKey(seed)) for seed in (0, 0, 1))
    for x, y in zip(jax.tree.leaves(one), jax.tree.leaves(same), strict=True):
        np.testing.assert_array_equal(x, y)
    differs = np.any(np.asarray(one.q != other.q), axis=1)
    assert 0 < differs.mean() < 0.5  # the restarts alone


def test_local_stays_near_the_warm_start(arm):
    center, half = (arm.lower + arm.upper) / 2, (arm.upper - arm.lower) / 2
    q0 = center + 0.8 * (arm.random(6) - center)
    nudge = np.random.default_rng(7).uniform(-0.02, 0.02, q0.shape)
    pos, quat = arm.poses(q0 + nudge)
    found = arm.local(pos, quat, jnp.array(q0, jnp.float32))
    assert np.all(0.2 * half > 0.02) and np.mean(found.success) > 0.99
    moved = np.max(np.abs(np.asarray(found.q) - q0), axis=1)
    assert np.percentile(moved, 95) < 0.1 and np.median(moved) < 0.03
    still = arm.local(*arm.poses(q0), jnp.array(q0, jnp.float32))
    np.testing.assert_array_equal(still.q, jnp.array(q0, jnp.float32))
    assert np.all(still.success)


def test_local_never_restarts(arm):
    pos, quat = arm.poses(arm.random(8))
    alone, helped = arm.local(pos, quat, arm.home), arm.solve(pos, quat, arm.home, jax.random.PRNGKey(0))
    assert 0.5 < np.mean(alone.success) < np.mean(helped.success)
    same = np.all(np.abs(alone.q - helped.q) < 1e-3, axis=1)  # but where rounding tips a descent from afar
    assert np.mean(same[alone.success]) > 0.98


def test_a_path_goes_from_pose_to_pose_and_each_pose_stands_alone():
    """A path's first poses are found with restarts, its later ones only from the ones before, as ``local`` finds them."""
    solver = ik.InverseKinematics(NERO, cfg=ik.IkCfg(restarts=2))
    q = np.random.default_rng(3).uniform(-0.2, 0.2, (2, 3, len(NERO.arm.joints))).astype(np.float32) + np.array(
        NERO.arm.home, np.float32
    )
    pos, quat = (x[..., 0, :] for x in jax.vmap(jax.vmap(solver.chain.poses))(jnp.asarray(q)))
    home, key = jnp.tile(jnp.array(NERO.arm.home), (3, 1)), jax.random.PRNGKey(0)
    path = jax.jit(solver.solve_path)(pos, quat, home, key)
    first = jax.jit(solver.solve_batch)(pos[0], quat[0], home, key)
    second = jax.jit(solver.each)(pos[1], quat[1], first.q)
    third = jax.jit(jax.vmap(solver.local))(pos[1], quat[1], first.q)
    assert first.success.any() and second.success.any()
    for found in (second, third):
        np.testing.assert_array_equal(path.success, [first.success, found.success])
        np.testing.assert_allclose(path.q[:, found.success], jnp.stack([first.q, found.q])[:, found.success], atol=2e-3)


def test_a_hand_that_cannot_be_turned_so_still_has_its_point_in_place():
    """Five joints, and poses turned by 0.4 rad from ones that they meet: by its frame alone the point is 3 mm beside."""
    arm, point = Arm(SO_ARM100), (0.02, 0.0, 0.0)
    q = 0.5 * arm.random(6, 32)
    pos, quat = arm.poses(q)
    quat = jax.vmap(math.quat_mul, (None, 0))(math.axis_angle(jnp.array([0.0, 0.0, 1.0]), jnp.array(0.4)), quat)
    place = pos + jax.vmap(math.rotate, (0, None))(quat, jnp.array(point))
    far = []
    for own, weight in (((0.0, 0.0, 0.0), 0.003), (point, 0.003), (point, 0.1)):
        solver = ik.InverseKinematics(arm.robot, point=own)
        found = jax.jit(jax.vmap(functools.partial(solver.local, weight=weight)))(pos, quat, jnp.array(q, jnp.float32))
        at, turn = (x[:, 0] for x in jax.vmap(solver.chain.poses)(found.q))
        there = at + jax.vmap(math.rotate, (0, None))(turn, jnp.array(point))
        far.append(np.median(np.linalg.norm(there - place, axis=1)))
    assert far[1] < 1e-3 < 2e-3 < far[0]
    assert far[1] < far[2]  # the more the orientation weighs, the farther the point is off


@pytest.mark.slow
def test_one_pose_as_in_a_batch():
    arm = Arm(NERO)
    pos, quat = arm.poses(arm.random(9))
    many = arm.solve(pos, quat, arm.home, jax.random.PRNGKey(0))
    solve = jax.jit(arm.solver.solve)
    one = [solve(pos[i], quat[i], arm.home[i], jax.random.PRNGKey(0)) for i in range(50)]
    assert one[0].q.shape == (7,) and one[0].success.shape == ()
    np.testing.assert_array_equal([bool(x.success) for x in one], many.success[:50])


def test_closed_form_of_the_cobotta_with_the_gripper_straight_down():
    """The flange at (x, y, z), turned by Rz(psi) Ry(pi)."""
    rng = np.random.default_rng(0)
    x, y, z = rng.uniform([0.3, -0.4, 0.15], [0.6, 0.4, 0.5], (N, 3)).T
    psi = rng.uniform(-1.0, 1.0, N)
    exact = cobotta_down(x, y, z, psi)
    pos = jnp.array(np.stack([x, y, z], axis=1), jnp.float32)
    quat = jnp.array(np.stack([0 * psi, -np.sin(psi / 2), np.cos(psi / 2), 0 * psi], axis=1), jnp.float32)

    solver = ik.InverseKinematics(COBOTTA_PRO_900, "flange", ik.IkCfg(position_tolerance=1e-5, orientation_tolerance=1e-5))
    at, turn = jax.jit(jax.vmap(solver.chain.poses))(jnp.array(exact, jnp.float32))
    np.testing.assert_allclose(at[:, 0], pos, rtol=0, atol=2e-6)
    np.testing.assert_allclose(np.abs(np.sum(turn[:, 0] * quat, axis=1)), 1.0, rtol=0, atol=1e-6)
    start = jnp.array(exact + rng.uniform(-0.1, 0.1, exact.shape), jnp.float32)
    found = jax.jit(jax.vmap(solver.local))(pos, quat, start)
    assert np.all(found.success)  # float32 is good for a hundredth of the default tolerances
    np.testing.assert_allclose(found.q, exact, rtol=0, atol=1e-3)


def test_unknown_frame():
    with pytest.raises(KeyError, match="nowhere"):
        ik.InverseKinematics(NERO, "nowhere")


@pytest.mark.slow
def test_benchmark():
    (ours, *_) = inverse_kinematics.measure_ik(NERO, [N], 1)
    assert (ours["solver"], ours["batch"], ours["poses"]) == ("mjx_nero", N, N)
    assert ours["success"] >= 0.99 and ours["error_mm"] < 1.0 and ours["error_mrad"] < 10.0
    assert ours["solves_per_s"] == pytest.approx(N / ours["ms_per_batch"] * 1e3, rel=0.01)


def test_benchmark_with_mink(arm):
    pytest.importorskip("mink")
    (row,) = inverse_kinematics.measure_mink(arm.robot, *(np.asarray(x) for x in arm.poses(arm.random(10, 20))))
    assert row["solver"] == "mink" and row["poses"] == 20 and row["success"] > 0.5 and row["error_mm"] < 1.0


def test_benchmark_without_mink(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "mink", None)
    assert inverse_kinematics.measure_mink(NERO, np.zeros((1, 3)), np.array([[1.0, 0, 0, 0]])) == []
    assert capsys.readouterr().out.count("\n") == 1
