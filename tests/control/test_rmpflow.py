"""RMPflow: leaves and algebra by hand, motions of both robots, and messages about bad files."""

import pathlib
import types

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import yaml
from model_checks import cobotta_down

from mjx_nero.control import rmp, rmpflow_config
from mjx_nero.control.rmp import Rmp
from mjx_nero.control.rmpflow import Obstacles, RmpFlow, Target
from mjx_nero.sim import scene
from mjx_nero.sim.robot import ASSETS
from mjx_nero.tasks import registry
from mjx_nero.tasks.arms.cobotta_pro_900 import COBOTTA_PRO_900
from mjx_nero.tasks.arms.nero import NERO
from mjx_nero.types import UserError

DT = 1 / 60
COBOTTA_DOWN, NERO_DOWN = np.array([0.0, 0, 1, 0]), np.array([0.0, 1, 0, 0])  # fingers along y
FILES = ASSETS / "cobotta_pro_900" / "rmpflow"
PARAMS = rmpflow_config.load(rmpflow_config.RmpFlowCfg, FILES / "rmpflow_common.yaml").rmp_params
HOME = np.array(COBOTTA_PRO_900.arm.home)


@pytest.fixture(scope="session")
def cobotta() -> RmpFlow:
    return RmpFlow(COBOTTA_PRO_900, "flange")


@pytest.fixture(scope="session")
def nero() -> RmpFlow:
    return RmpFlow(NERO)


# Leaves


def test_metrics_are_positive():
    rng = np.random.default_rng(0)
    for _ in range(100):
        q, qd, v = rng.normal(size=6), rng.uniform(-1.5, 1.5, 6), rng.normal(size=3)
        d = rng.normal(size=3) * 10.0 ** rng.uniform(-4, 0.5)
        x = np.abs(rng.normal(size=4)) * 10.0 ** rng.uniform(-4, 0) - 1e-3
        for leaf in (
            rmp.cspace_target_rmp(PARAMS.cspace_target_rmp, q, qd, np.zeros(6)),
            rmp.joint_limit_rmp(PARAMS.joint_limit_rmp, x, v[0]),
            rmp.joint_velocity_cap_rmp(PARAMS.joint_velocity_cap_rmp, qd),
            rmp.damping_rmp(PARAMS.damping_rmp, v[0]),
            rmp.collision_rmp(PARAMS.collision_rmp, x, v[0]),
        ):
            assert np.all(np.isfinite(leaf.force)) and np.all(np.asarray(leaf.metric) >= 0)
        n = rmp.along(jnp.asarray(d / np.linalg.norm(d)), 0.3, rmp.collision_rmp(PARAMS.collision_rmp, x[0], v[0]))
        for leaf in (
            n,
            rmp.target_rmp(PARAMS.target_rmp, d, v),
            rmp.axis_target_rmp(PARAMS.axis_target_rmp, d, v, abs(d[0])),
            rmp.axis_target_rmp(PARAMS.axis_target_rmp, d, v, None),
        ):
            metric = np.asarray(leaf.metric, np.float64)
            np.testing.assert_array_equal(metric, metric.T)
            eigenvalues = np.linalg.eigvalsh(metric)
            assert eigenvalues[0] >= -1e-6 * eigenvalues[-1]


def test_cspace_target():
    # error 2 on one joint, beyond the threshold of 0.5: 100 x 0.5 - 50 x 0.1 = 45, times 50; 100 x 0 on the other
    leaf = rmp.cspace_target_rmp(PARAMS.cspace_target_rmp, jnp.array([-2.0, 0]), jnp.array([0.1, 0]), np.zeros(2))
    np.testing.assert_allclose(leaf.force, [2250, 0], rtol=1e-5)
    np.testing.assert_allclose(leaf.metric, [51, 51])  # with the inertia
    near = rmp.cspace_target_rmp(PARAMS.cspace_target_rmp, jnp.array([-0.2, 0]), jnp.zeros(2), np.zeros(2))
    np.testing.assert_allclose(near.force, [1000, 0], rtol=1e-5)


def test_joint_limit():
    # at rest the gate is a half: m = 0.5 x 1000 / (0.1/0.01 + 0.001) = 49.995, a = 1 / (1 + 0.01)
    leaf = rmp.joint_limit_rmp(PARAMS.joint_limit_rmp, 0.1, 0.0)
    np.testing.assert_allclose([leaf.metric, leaf.force], [49.995, 49.5], rtol=1e-4)
    # on the way in at 0.05: gate 1/(1 + exp(-5)), a + 200 x 0.05
    leaf = rmp.joint_limit_rmp(PARAMS.joint_limit_rmp, 0.1, -0.05)
    np.testing.assert_allclose([leaf.metric, leaf.force / leaf.metric], [0.993307 * 99.99, 10.990099], rtol=1e-4)
    beyond = rmp.joint_limit_rmp(PARAMS.joint_limit_rmp, -0.3, 0.0)
    np.testing.assert_allclose([beyond.metric, beyond.force], [5e5, 5e7], rtol=1e-4)  # as at the limit


def test_joint_velocity_cap():
    # 0.85 is half way into the region of 0.3 below 1: a = -1000 x 0.15, m = 100 / (1 - 0.25)
    leaf = rmp.joint_velocity_cap_rmp(PARAMS.joint_velocity_cap_rmp, jnp.array([0.5, 0.85, -0.85, 3.0]))
    np.testing.assert_allclose(leaf.metric[:3], [0, 133.333, 133.333], rtol=1e-4)
    np.testing.assert_allclose(leaf.force[:3], [0, -20000, 20000], rtol=1e-4)
    assert leaf.metric[3] > 1e5 and np.isfinite(leaf.force[3])


def test_target():
    # 0.05 m away: alpha = 0.99 exp(-0.5) + 0.01 = 0.610465, beta = exp(-3.125) = 0.0439369, boost 1.834802
    # along x: (0.610465 x 10000 + 0.389535 x 2500) x boost; across: the first part alone. a = 30 x 0.05 / 0.125 - 85 v
    leaf = rmp.target_rmp(PARAMS.target_rmp, jnp.array([0.05, 0, 0]), jnp.array([0.02, 0.01, 0]))
    along, across = 7078.49 * 1.834802, 6104.65 * 1.834802
    np.testing.assert_allclose(leaf.metric, np.diag([along, across, across]), rtol=1e-4, atol=1e-2)
    np.testing.assert_allclose(leaf.force, [along * 10.3, across * -0.85, 0], rtol=1e-4, atol=1e-2)


def test_axis_target():
    # 0.08 m away: beta = exp(-0.5) = 0.606531, boost 1819.987; a = 210 x 0.1 - 60 x 0.2
    leaf = rmp.axis_target_rmp(PARAMS.axis_target_rmp, jnp.array([0.1, 0, 0]), jnp.array([0.2, 0, 0]), 0.08)
    np.testing.assert_allclose(leaf.metric, 18199.87 * np.eye(3), rtol=1e-4)
    np.testing.assert_allclose(leaf.force, [18199.87 * 9, 0, 0], rtol=1e-4)
    leaf = rmp.axis_target_rmp(PARAMS.axis_target_rmp, jnp.array([0.1, 0, 0]), jnp.zeros(3), None)
    np.testing.assert_allclose(leaf.metric, 10 * np.eye(3))


def test_damping():
    leaf = rmp.damping_rmp(PARAMS.damping_rmp, jnp.array([-0.2, 0.0]))
    np.testing.assert_allclose(leaf.metric, [110, 100])  # 50 x 0.2 + 100
    np.testing.assert_allclose(leaf.force, [10 * 30 * 0.04, 0], rtol=1e-6)


def test_collision():
    # 0.02 m away at rest: gate a half, (1 - 0.04)^2 = 0.9216, m = 0.5 x 0.9216 x 10000 / 1.001, a = 800 exp(-2)
    leaf = rmp.collision_rmp(PARAMS.collision_rmp, jnp.array([0.02, 0.6, -0.1]), jnp.zeros(3))
    np.testing.assert_allclose(leaf.metric, [4603.4, 0, 5e6], rtol=1e-4)  # out of range; at the surface
    np.testing.assert_allclose(leaf.force[0], 4603.4 * 108.268, rtol=1e-4)
    # approaching at 0.05: damper 50 x g x 0.05 / (0.5 + 0.01), g = 0.993307
    leaf = rmp.collision_rmp(PARAMS.collision_rmp, 0.02, -0.05)
    np.testing.assert_allclose(leaf.force / leaf.metric, 108.268 + 50 * 0.993307 * 0.05 / 0.51, rtol=1e-4)


# The tree


def test_resolve_of_two_leaves_on_one_joint():
    # 2 x 3 + 5 x (-1) over 2 + 5
    accel = rmp.resolve(limit(1e9), Rmp(jnp.array([2 * 3.0 + 5 * -1.0]), jnp.array([[7.0]])))
    np.testing.assert_allclose(accel, [1 / 7], rtol=1e-5)


def limit(norm: float) -> rmpflow_config.ResolveCfg:
    return rmpflow_config.ResolveCfg(max_acceleration_norm=norm)


def test_planar_arm():
    """Two links of 1 m, a force on the tip and one on the elbow, against the textbook's formulas in numpy."""
    q, qd = np.array([0.4, 0.9]), np.array([0.7, -0.3])
    (c1, s1), (c12, s12), w = (np.cos(q[0]), np.sin(q[0])), (np.cos(q.sum()), np.sin(q.sum())), qd.sum()
    elbow, tip = np.array([[-s1, 0], [c1, 0], [0, 0]]), np.array([[-s1 - s12, -s12], [c1 + c12, c12], [0, 0]])
    bend_elbow = -(qd[0] ** 2) * np.array([c1, s1, 0])  # centripetal
    bend_tip = bend_elbow - w**2 * np.array([c12, s12, 0])
    a_elbow, a_tip = np.array([1.0, -2, 5]), np.array([-3.0, 0.5, 7])
    m_elbow, m_tip = np.diag([2.0, 3, 4]), np.array([[5.0, 1, 0], [1, 6, 0.5], [0, 0.5, 2]])
    metric = elbow.T @ m_elbow @ elbow + tip.T @ m_tip @ tip
    force = elbow.T @ m_elbow @ (a_elbow - bend_elbow) + tip.T @ m_tip @ (a_tip - bend_tip)

    node = Rmp(jnp.array([m_elbow @ a_elbow, m_tip @ a_tip]), jnp.array([m_elbow, m_tip]))
    root = rmp.pull_back(jnp.array([elbow, tip]), jnp.array([bend_elbow, bend_tip]), node)
    np.testing.assert_allclose(root.metric, metric, rtol=1e-5)
    np.testing.assert_allclose(root.force, force, rtol=1e-5)
    expected = np.linalg.pinv(metric) @ force
    np.testing.assert_allclose(rmp.resolve(limit(1e9), root), expected, rtol=1e-4)
    clipped = np.asarray(rmp.resolve(limit(0.1), root))
    np.testing.assert_allclose(clipped, 0.1 * expected / np.linalg.norm(expected), rtol=1e-4)


def test_resolve_where_no_leaf_cares():
    metric = jnp.diag(jnp.array([2e5, 3.0, 0.0]))
    np.testing.assert_allclose(rmp.resolve(limit(50), Rmp(jnp.array([2e5, 6.0, 0]), metric)), [1, 2, 0], rtol=1e-2)


@pytest.mark.parametrize("t", [-0.4, 0.3, 1.5])
def test_clearance_along_a_straight_flight(t):
    """Rate and second derivative against differences in double precision, beside the segment and beyond both its ends."""
    pt1, pt2, vel = np.array([0.1, 0, 0.2]), np.array([0.3, 0.4, 0.1]), np.array([0.3, -0.2, 0.5])
    point = pt1 + t * (pt2 - pt1) + np.array([0.2, 0.1, 0.3])

    def distance(time):
        p = point + time * vel
        share = np.clip((p - pt1) @ (pt2 - pt1) / np.sum((pt2 - pt1) ** 2), 0, 1)
        return np.linalg.norm(p - pt1 - share * (pt2 - pt1))

    h = 1e-4
    d, n, rate, bend = rmp.clearance(*(jnp.asarray(x, jnp.float32) for x in (point, vel, pt1, pt2)))
    np.testing.assert_allclose(d, distance(0), rtol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(n), 1, rtol=1e-5)
    np.testing.assert_allclose(rate, (distance(h) - distance(-h)) / (2 * h), rtol=1e-4)
    np.testing.assert_allclose(bend, (distance(h) - 2 * distance(0) + distance(-h)) / h**2, rtol=1e-3)


QUARTER = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # about z: its edges along x, y and z are 0.4, 0.2 and 0.6


@pytest.mark.parametrize(
    ("point", "vel", "distance", "direction", "rate", "bend"),
    [
        # Over a face: a plane's distance, however fast it goes along.
        ([0.5, 0.05, 0.1], [-1.0, 2.0, 3.0], 0.3, [1, 0, 0], -1.0, 0.0),
        # Beyond an edge, 3 and 4 cm off: a cylinder's. Along the edge nothing turns; across it 2 m/s make 4 / 0.05.
        ([0.23, 0.14, 0.1], [0.6, 0.8, 5.0], 0.05, [0.6, 0.8, 0], 1.0, 0.0),
        ([0.23, 0.14, 0.1], [-1.6, 1.2, 5.0], 0.05, [0.6, 0.8, 0], 0.0, 80.0),
        # Beyond a corner, 2, 3 and 6 cm off: a sphere's of 7 cm.
        ([-0.22, 0.13, -0.36], [3.0, 2.0, 0.0], 0.07, [-2 / 7, 3 / 7, -6 / 7], 0.0, 13 / 0.07),
        # Within: 1 cm below the face to y, and out that way.
        ([0.1, 0.09, 0.0], [5.0, 1.0, 7.0], -0.01, [0, 1, 0], 1.0, 0.0),
    ],
)
def test_clearance_of_a_box_by_hand(point, vel, distance, direction, rate, bend):
    center = np.array([1.0, 2.0, 3.0])
    given = (np.array(point) + center, vel, center, QUARTER, [0.2, 0.4, 0.6])
    got = rmp.box_clearance(*(jnp.asarray(x, jnp.float32) for x in given))
    np.testing.assert_allclose(got[0], distance, atol=2e-6)
    np.testing.assert_allclose(got[1], direction, atol=1e-4)
    np.testing.assert_allclose(got[2], rate, atol=1e-4)
    np.testing.assert_allclose(got[3], bend, rtol=1e-3, atol=1e-2)


def test_nodes_against_mujoco(nero):
    model = scene.robot_model(NERO)
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    nodes = jax.jit(lambda q, qd: nero._nodes(q, qd, len(nero._frame)))
    spheres = yaml.safe_load((ASSETS / "nero" / "rmpflow" / "robot_descriptor.yaml").read_text())["collision_spheres"]
    centres = [(link, sphere["center"]) for entry in spheres for link, links in entry.items() for sphere in links]
    ee = model.site("ee")
    jac, dot, turn, turn_dot = (np.zeros((3, model.nv)) for _ in range(4))
    for _ in range(5):
        q, qd = rng.uniform(-1, 1, 7), rng.uniform(-1, 1, 7)
        data.qpos[:7], data.qvel[:7] = q, qd
        mujoco.mj_forward(model, data)
        x, xd, bend, j = (np.asarray(v) for v in nodes(jnp.asarray(q, jnp.float32), jnp.asarray(qd, jnp.float32)))
        wanted = [(0, int(ee.bodyid[0]), data.site("ee").xpos)]
        for i, (link, centre) in enumerate(centres):
            body = data.body(link)
            wanted.append((6 + i, body.id, body.xpos + body.xmat.reshape(3, 3) @ centre))  # after origin, axes, controllers
        for i, body_id, point in wanted:
            mujoco.mj_jac(model, data, jac, turn, point, body_id)
            mujoco.mj_jacDot(model, data, dot, turn_dot, point, body_id)
            np.testing.assert_allclose(x[i], point, atol=2e-6)
            np.testing.assert_allclose(j[i], jac[:, :7], atol=2e-6)
            np.testing.assert_allclose(xd[i], jac[:, :7] @ qd, atol=1e-5)
            np.testing.assert_allclose(bend[i], dot[:, :7] @ qd, atol=1e-5)
        axes = data.site("ee").xmat.reshape(3, 3).T
        mujoco.mj_jac(model, data, jac, turn, data.site("ee").xpos, int(ee.bodyid[0]))
        mujoco.mj_jacDot(model, data, dot, turn_dot, data.site("ee").xpos, int(ee.bodyid[0]))
        spin, push = turn[:, :7] @ qd, turn_dot[:, :7] @ qd
        for i, axis in enumerate(axes):
            np.testing.assert_allclose(x[1 + i], axis, atol=2e-6)
            np.testing.assert_allclose(xd[1 + i], np.cross(spin, axis), atol=1e-5)
            np.testing.assert_allclose(bend[1 + i], np.cross(push, axis) + np.cross(spin, np.cross(spin, axis)), atol=1e-5)


@pytest.fixture(scope="session")
def accelerate(cobotta):
    """The policy of 64 robots."""
    return jax.jit(jax.vmap(cobotta.acceleration, (0, 0, 0, None)))


def test_acceleration_is_limited(cobotta, accelerate):
    rng = np.random.default_rng(0)
    q = jnp.asarray(rng.uniform(0.9 * cobotta.chain.lower, 0.9 * cobotta.chain.upper, (64, 6)), jnp.float32)
    qd = jnp.asarray(rng.uniform(-1, 1, (64, 6)), jnp.float32)
    target = Target(jnp.asarray(rng.uniform(-0.5, 0.5, (64, 3)), jnp.float32), jnp.tile(jnp.array([0.0, 0, 1, 0]), (64, 1)))
    norms = np.linalg.norm(accelerate(q, qd, target, Obstacles.none()), axis=1)
    assert np.all(norms <= 50 * (1 + 1e-5)) and norms.max() > 49.9


def test_one_robot_in_substeps_agrees_with_a_batch(cobotta, accelerate):
    """0.01 s in substeps of at most 0.00334 s: three Euler steps."""
    rng = np.random.default_rng(1)
    target, obstacles = Target(jnp.array([0.4, 0.1, 0.4]), jnp.array([0.0, 0, 1, 0])), Obstacles.none()
    targets = jax.tree.map(lambda x: jnp.tile(x, (64, 1)), target)
    q, qd = (jnp.asarray(x, jnp.float32) for x in (HOME + rng.uniform(-0.3, 0.3, (64, 6)), rng.uniform(-0.5, 0.5, (64, 6))))
    step = jax.jit(lambda q, qd: cobotta.step(q, qd, target, obstacles, 0.01))
    stepped = [step(q[i], qd[i]) for i in range(8)]
    for _ in range(3):
        q, qd = q + 0.01 / 3 * qd, qd + 0.01 / 3 * accelerate(q, qd, targets, obstacles)
    for i, (position, velocity) in enumerate(stepped):
        np.testing.assert_allclose(position, q[i], atol=2e-6)
        np.testing.assert_allclose(velocity, qd[i], atol=5e-4)


# Motions: the policy integrated, its set-points reached exactly


def roll_out(flow: RmpFlow, q0, centre, quat, radius, obstacle, steps: int):
    """A batch of motions to targets on circles at 0.25 Hz: joints, position [m] and orientation error [rad] after each step."""

    @jax.jit
    @jax.vmap
    def run(q0, centre, quat, radius, obstacle):
        def target(step):
            angle, speed = 2 * jnp.pi * 0.25 * step * DT, 2 * jnp.pi * 0.25 * radius
            offset, velocity = jnp.array([jnp.cos(angle), jnp.sin(angle), 0]), jnp.array([-jnp.sin(angle), jnp.cos(angle), 0])
            return Target(centre + radius * offset, quat, speed * velocity)

        def body(state, i):
            state = flow.step(*state, target(i), obstacle, DT)
            pos, turn = flow.chain.poses(state[0])
            error = 2 * jnp.arccos(jnp.minimum(jnp.abs(turn[0] @ quat), 1.0))
            return state, (*state, jnp.linalg.norm(pos[0] - target(i + 1).position), error, pos[0])

        return jax.lax.scan(body, (q0, jnp.zeros_like(q0)), jnp.arange(steps))[1]

    n = len(q0)
    arrays = (q0, centre, np.broadcast_to(quat, (n, 4)), radius)
    q, qd, position, orientation, pos = run(*(jnp.asarray(x, jnp.float32) for x in arrays), obstacle)
    out = {"q": q, "qd": qd, "position": position, "orientation": orientation, "pos": pos}
    return [types.SimpleNamespace(**{k: np.asarray(v[i]) for k, v in out.items()}) for i in range(n)]


def settles(run, position=0.005, orientation=0.05) -> float:
    """When the errors fall below the tolerances [m], [rad] for good [s]; inf: never."""
    out = np.nonzero((run.position > position) | (run.orientation > orientation))[0]
    return 0.0 if not len(out) else np.inf if out[-1] + 1 == len(run.position) else (out[-1] + 1) * DT


SPHERE, POST, AWAY = ((0.5, 0, 0.45), (0.5, 0, 0.45), 0.08), ((0.6, 0, 0), (0.6, 0, 0.5), 0.05), ((5, 5, 5), (5, 5, 5), 0.1)


@pytest.fixture(scope="session")
def cobotta_runs(cobotta):
    left = cobotta_down(0.5, -0.3, 0.45)
    runs = {  # start, centre and radius of the target's circle, obstacle
        "zeros": (np.zeros(6), (0.5, 0, 0.5), 0.0, AWAY),
        "place": (HOME, (-0.3, 0.6, 0.45), 0.0, AWAY),
        "circle": (HOME, (0.5, 0, 0.5), 0.1, AWAY),
        "out of reach": (HOME, (1.5, 0, 0.5), 0.0, AWAY),
        "free": (left, (0.5, 0.3, 0.45), 0.0, AWAY),
        "sphere": (left, (0.5, 0.3, 0.45), 0.0, SPHERE),
        "post": (left, (0.5, 0.3, 0.45), 0.0, POST),
    }
    q0, centre, radius, obstacle = zip(*runs.values(), strict=True)
    pt1, pt2, size = (jnp.asarray(x, jnp.float32)[:, None] for x in zip(*obstacle, strict=True))
    done = roll_out(cobotta, q0, centre, COBOTTA_DOWN, radius, Obstacles(pt1, pt2, size), steps=480)
    return dict(zip(runs, done, strict=True))


def test_cobotta_reaches_its_targets(cobotta_runs):
    for name, time in (("zeros", 4.5), ("place", 5.5)):
        run = cobotta_runs[name]
        assert settles(run) < time
        assert run.position[-1] < 2e-4 and run.orientation[-1] < 2e-3


def test_speeds_and_joint_limits(cobotta, cobotta_runs):
    for run in cobotta_runs.values():
        assert np.all(np.abs(run.qd) <= 1.0)
        assert np.all((run.q > cobotta.chain.lower) & (run.q < cobotta.chain.upper))


def test_moving_target_is_tracked_without_lag(cobotta_runs):
    assert cobotta_runs["circle"].position[240:].max() < 2e-3  # at 0.157 m/s; 52 mm without the target's velocity


def test_target_out_of_reach(cobotta_runs):
    """The stretched arm's flange is 0.447 m from it."""
    run = cobotta_runs["out of reach"]
    assert 0.44 < run.position[-1] < 0.48
    assert np.abs(run.qd[-1]).max() < 0.01


@pytest.mark.parametrize(("name", "obstacle"), [("sphere", SPHERE), ("post", POST)])
def test_obstacle_is_avoided(cobotta, cobotta_runs, name, obstacle):
    pt1, pt2, radius = np.array(obstacle[0]), np.array(obstacle[1]), obstacle[2]
    spheres = jax.jit(jax.vmap(cobotta.spheres))

    def gap(run):
        centres, size = (np.asarray(x) for x in spheres(run.q))
        share = np.clip((centres - pt1) @ (pt2 - pt1) / max(np.sum((pt2 - pt1) ** 2), 1e-9), 0, 1)
        return (np.linalg.norm(centres - pt1 - share[..., None] * (pt2 - pt1), axis=-1) - size - radius).min()

    assert gap(cobotta_runs["free"]) < -0.05  # the way leads through it
    assert gap(cobotta_runs[name]) > 0.02
    assert settles(cobotta_runs[name]) < 5


@pytest.fixture(scope="session")
def nero_runs(nero):
    targets = [(0.3, 0, 0.1), (0.4, 0.15, 0.05), (0.45, -0.15, 0.15), (0.35, 0.3, 0.15), (0.4, -0.3, 0.1), (0.4, 0, 0.2)]
    targets += [(0.5, 0.3, 0.2), (0.5, 0, 0.4), (-0.4, 0, 0.2)]  # out of reach, straight down: joint 7 would have to turn further
    far = jnp.full((len(targets), 1, 3), 5.0)
    q0 = np.tile(NERO.arm.home, (len(targets), 1))
    return roll_out(nero, q0, targets, NERO_DOWN, np.zeros(len(targets)), Obstacles(far, far, far[..., 0] / 50), steps=360)


def test_nero_reaches_its_targets(nero_runs):
    for run in nero_runs[:6]:
        assert settles(run) < 5
        assert run.position[-1] < 2e-3


def test_nero_stays_within_its_limits(nero, nero_runs):
    for run in nero_runs:
        assert np.all(np.abs(run.qd) <= 1.0)
        assert np.all((run.q > nero.chain.lower) & (run.q < nero.chain.upper))
    assert nero_runs[6].q[-1, 6] > 1.5  # pulled towards the limit at 1.571


@pytest.mark.slow
def test_tutorials_own_files(tmp_path):
    """Upright as the preferred posture, and no spheres but the hand's: times and errors of an independent implementation."""
    descriptor = yaml.safe_load((FILES / "robot_descriptor.yaml").read_text())
    del descriptor["collision_spheres"]
    path = tmp_path / "robot_descriptor.yaml"
    path.write_text(yaml.safe_dump(descriptor | {"default_q": [0.0] * 6}))
    flow = RmpFlow(COBOTTA_PRO_900, "onrobot_rg6_base_link", descriptor=path)
    none = jax.tree.map(lambda x: jnp.zeros((2, *x.shape)), Obstacles.none())
    runs = roll_out(flow, [np.zeros(6), HOME], [(0.5, 0, 0.5), (-0.3, 0.6, 0.45)], COBOTTA_DOWN, np.zeros(2), none, steps=480)
    assert settles(runs[0]) == pytest.approx(4.1, abs=0.2)
    assert settles(runs[1]) < 5.6
    for run in runs:
        assert run.position[-1] < 1.1e-4 and run.orientation[-1] < 1e-3 and np.abs(run.qd).max() < 0.97


# Files


@pytest.mark.parametrize("arm", ["piper", "so_arm100", "so_arm101"])
def test_spheres_cover_what_can_touch_an_obstacle(arm):
    """To 10 mm: ends and sides of the shapes that meet obstacles, in the preferred posture with closed fingers."""
    robot = registry.robot(arm)
    flow, model = RmpFlow(robot), scene.robot_model(robot)
    centres, radii = (np.asarray(x) for x in flow.spheres(jnp.asarray(flow.default_q)))
    data = mujoco.MjData(model)
    data.qpos[[model.joint(name).qposadr[0] for name in robot.arm.joints]] = flow.default_q
    mujoco.mj_kinematics(model, data)
    shapes = [i for i in range(model.ngeom) if model.geom_conaffinity[i] & 9]
    assert len(shapes) > 4
    for i in shapes:
        size, kind = model.geom_size[i], model.geom_type[i]
        half = size[1] if kind == mujoco.mjtGeom.mjGEOM_CAPSULE else 0.0
        for along in np.linspace(-half, half, 5):
            for side in size[0] * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]]):
                point = data.geom_xpos[i] + data.geom_xmat[i].reshape(3, 3) @ (side + [0, 0, along])
                off = (np.linalg.norm(centres - point, axis=1) - radii).min()
                assert off < 0.01, (model.geom(i).name, along, off)


def test_parameters_of_another_robot(tmp_path):
    """Nero's are the Cobotta's, but for what its own file says."""
    nero = rmpflow_config.load(rmpflow_config.RmpFlowCfg, ASSETS / "nero" / "rmpflow" / "rmpflow_common.yaml")
    assert nero.rmp_params == PARAMS and len(nero.joint_limit_buffers) == 7
    assert [each.name for each in nero.body_collision_controllers] == ["gripper_base", "ee"]
    for other in ("../nero", "panda"):
        path = tmp_path / "rmpflow_common.yaml"
        path.write_text(f"like: {other}")
        with pytest.raises(UserError, match=f"rmpflow_common.yaml: like: no robot '{other}'"):
            rmpflow_config.load(rmpflow_config.RmpFlowCfg, path)


def test_tutorials_numbers_are_read():
    text = (FILES / "rmpflow_common.yaml").read_text()
    assert "metric_exploder_eps: 1e-3" in text  # which YAML 1.1 takes for a string
    assert PARAMS.joint_limit_rmp.metric_exploder_eps == 1e-3
    assert PARAMS.cspace_affine_rmp.weight == 2000


def test_joints_in_another_order(tmp_path, nero):
    descriptor = yaml.safe_load((ASSETS / "nero" / "rmpflow" / "robot_descriptor.yaml").read_text())
    descriptor["cspace"].reverse()
    descriptor["default_q"].reverse()
    path = tmp_path / "robot_descriptor.yaml"
    path.write_text(yaml.safe_dump(descriptor))
    flow = RmpFlow(NERO, descriptor=path)
    assert flow.joints == nero.joints
    np.testing.assert_array_equal(flow.default_q, nero.default_q)


def bad(tmp_path: pathlib.Path, file: str, old: str, new: str) -> tuple[pathlib.Path, str]:
    """The message about a file of the Cobotta's with one change."""
    text = (FILES / file).read_text()
    assert old in text
    path = tmp_path / file
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(UserError) as error:
        RmpFlow(COBOTTA_PRO_900, **{"config" if "common" in file else "descriptor": path})
    return path, str(error.value)


BAD = {
    "rmpflow_common.yaml": [
        (
            "accel_p_gain: 30.",
            "acel_p_gain: 30.",
            ["rmp_params.target_rmp.acel_p_gain", "did you mean 'accel_p_gain'?", "accel_d_gain"],
        ),
        ("accel_p_gain: 30.", "accel_p_gain: fast", ["target_rmp.accel_p_gain takes a finite number, got 'fast'"]),
        ("accel_p_gain: 30.", "accel_p_gain: 30 N", ["got '30 N'"]),
        ("accel_p_gain: 30.", "accel_p_gain: true", ["got True"]),
        ("accel_p_gain: 30.", "accel_p_gain: .nan", ["got nan"]),
        ("accel_p_gain: 30.", "accel_p_gain: [30.]", ["got [30.0]"]),
        ("accel_p_gain: 30.", "accel_p_gain:", ["got None"]),
        ("accel_p_gain: 30.", "accel_p_gain: -30.", ["accel_p_gain must be at least 0, got -30.0"]),
        ("accel_norm_eps: .075", "accel_norm_eps: 0", ["accel_norm_eps must be above 0, got 0"]),
        ("min_metric_alpha: .01", "min_metric_alpha: 2", ["min_metric_alpha must be at least 0 and at most 1, got 2"]),
        ("accept_user_weights: false", "accept_user_weights: 1", ["accept_user_weights takes true or false, got 1"]),
        ("        accel_p_gain: 30.\n", "", ["rmp_params.target_rmp.accel_p_gain is missing"]),
        ("damping_rmp:", "dampin_rmp:", ["rmp_params.dampin_rmp", "did you mean 'damping_rmp'?"]),
        ("canonical_resolve:", "canonical:", ["canonical", "did you mean 'canonical_resolve'?"]),
        ("joint_limit_buffers: [.01, ", "joint_limit_buffers: [", ["joint_limit_buffers takes 6 numbers", "got 5"]),
        ("joint_limit_buffers: [.01, ", "joint_limit_buffers: [9, ", ["joint_limit_buffers leave joint_1 no range"]),
        (
            "velocity_damping_region: .3",
            "velocity_damping_region: 3",
            ["velocity_damping_region takes a number up to max_velocity, 1"],
        ),
        ("pt2: [0,0,0.]", "pt2: [0,0]", ["body_cylinders[0].pt2 takes a list of 3 numbers, got [0, 0]"]),
        (
            "onrobot_rg6_base_link",
            "onrobot_rg6_base",
            ["body_collision_controllers[0].name", "did you mean 'onrobot_rg6_base_link'?"],
        ),
        ("rmp_params:", "rmp_params: [", ["is not YAML in line"]),
        ("rmp_params:", "- rmp_params:", ["is not YAML in line"]),
    ],
    "robot_descriptor.yaml": [
        ("- joint_3\n", "- joint3\n", ["cspace[2]", "no joint 'joint3'", "did you mean 'joint_3'?", "joint_6"]),
        ("    - joint_3\n", "", ["cspace must name each joint of the arm once"]),
        ("- joint_3\n", "- joint_2\n", ["cspace must name each joint of the arm once"]),
        ("- joint_3\n", "- 3\n", ["cspace[2] takes a name, got 3"]),
        ("default_q: [0.0, ", "default_q: [", ["default_q takes 6 numbers", "got 5"]),
        ("default_q: [0.0, ", "default_q: [zero, ", ["default_q[0] takes a finite number, got 'zero'"]),
        ("root_link: world", "root_link: base", ["root_link", "world, base_link"]),
        ("cspace_to_urdf_rules: []", "cspace_to_urdf_rules: [{name: joint_6, rule: fixed, value: 0}]", ["must be empty"]),
        ("- J3:", "- J7:", ["collision_spheres[1]", "no frame 'J7'", "J3"]),
        ("radius: 0.08}", "radius: 0}", ["collision_spheres[0].J2[0].radius must be above 0"]),
        ("radius: 0.08}", "size: 0.08}", ["collision_spheres[0].J2[0].size: no key 'size'", "center, radius"]),
        ("collision_spheres:", "collision_sphere:", ["did you mean 'collision_spheres'?"]),
    ],
}


@pytest.mark.parametrize(("name", "old", "new", "words"), [(name, *case) for name, cases in BAD.items() for case in cases])
def test_bad_files_of_parameters(tmp_path, name, old, new, words):
    path, message = bad(tmp_path, name, old, new)
    assert message.startswith(f"{path}") and "\n" not in message
    assert all(word in message for word in words), message


@pytest.mark.parametrize(
    ("content", "words"),
    [(None, "there is no file"), (b"", "takes entries"), (b"5", "takes entries"), (b"\xff\xfe\xff", "is not YAML")],
)
def test_bad_files(tmp_path, content, words):
    path = tmp_path / "file.yaml"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(UserError, match=words) as error:
        RmpFlow(COBOTTA_PRO_900, config=path)
    assert str(path) in str(error.value) and "\n" not in str(error.value)


def test_bad_arguments():
    with pytest.raises(UserError, match="no frame 'flang' .did you mean 'flange'"):
        RmpFlow(COBOTTA_PRO_900, "flang")
    with pytest.raises(UserError, match="maximum_substep_size"):
        RmpFlow(COBOTTA_PRO_900, maximum_substep_size=0.0)
