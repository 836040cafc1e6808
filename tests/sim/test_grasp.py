"""A scripted grasp: the gripper lifts and holds the cube by friction, apart from any learning, on both physics backends."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.optimize import least_squares

# Corners, edges and middle of the region where cubes start.
PLACES = [(0.3, -0.1), (0.3, 0.2), (0.4, -0.1), (0.4, 0.2), (0.35, 0.05), (0.3, 0.05), (0.4, 0.05), (0.35, -0.1)]
DESCENT = (0.12, 0.09, 0.06, 0.04, 0.017)  # heights of the grasp point over the table [m]
ASCENT = (0.04, 0.08, 0.12, 0.16, 0.2, 0.23, 0.25)
OVER = (0.3, 0.0)  # the ascent ends half-way to here: far out and high up the wrist can't look straight down
HELD = 50  # control steps, one second, at the end
CUBE = slice(9, 12)


def top_down(model: mujoco.MjModel, x: float, y: float, z: float, start: np.ndarray) -> np.ndarray:
    """Arm joints that put the grasp point at a place, looking down, the fingers moving along the world's y."""
    data, low, high = mujoco.MjData(model), *model.jnt_range[:7].T
    down = np.diag([1.0, -1.0, -1.0])

    def error(q):
        data.qpos[:7] = q
        mujoco.mj_kinematics(model, data)
        site = data.site("ee")
        turn = site.xmat.reshape(3, 3) @ down.T
        axis = [turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]
        return np.concatenate([(site.xpos - [x, y, z]) * 10, axis, 1e-3 * (q - start)])

    margin = 0.01  # from the joint limits
    found = least_squares(error, np.clip(start, low + margin, high - margin), bounds=(low + margin, high - margin))
    assert np.abs(found.fun[:3]).max() / 10 < 2e-3 and np.abs(found.fun[3:6]).max() < 0.02, (x, y, z, found.fun)
    return found.x


def with_sag(model: mujoco.MjModel, q: np.ndarray, stiffness) -> np.ndarray:
    """Targets under which the arm comes to rest at ``q``: the drives give way to gravity."""
    data = mujoco.MjData(model)
    data.qpos[:7] = q
    mujoco.mj_forward(model, data)
    return q + data.qfrc_bias[:7] / np.array(stiffness)


@pytest.fixture(scope="session")
def script(env) -> tuple[np.ndarray, np.ndarray]:
    """Arm targets [steps, place, 7] and the gripper's action [steps]."""
    model, arm, stiffness = env.physics_model, np.array(env.cfg.robot.arm.home), env.cfg.robot.arm.stiffness
    paths = []
    for x, y in PLACES:
        q, down, up = arm, [], []
        for z in DESCENT:
            q = top_down(model, x, y, z, q)
            down.append(with_sag(model, q, stiffness))
        for i, z in enumerate(ASCENT):
            way = 0.5 * i / (len(ASCENT) - 1)
            q = top_down(model, x + way * (OVER[0] - x), y + way * (OVER[1] - y), z, q)
            up.append(with_sag(model, q, stiffness))
        paths.append((down, up))
    down, up = (np.swapaxes(np.array(p), 0, 1) for p in zip(*paths, strict=True))

    def along(points, steps):
        at = np.linspace(0, len(points) - 1, steps)
        i = np.minimum(at.astype(int), len(points) - 2)
        f = (at - i)[:, None, None]
        return points[i] * (1 - f) + points[i + 1] * f

    hold = [(np.repeat(p[None], n, axis=0), grip) for p, n, grip in [(down[0], 150, 1), (down[-1], 100, 1), (down[-1], 30, -1)]]
    final = np.repeat(up[-1][None], 100 + HELD, axis=0)
    phases = [hold[0], (along(down, 80), 1), hold[1], hold[2], (along(up, 120), -1), (final, -1)]
    return np.concatenate([p for p, _ in phases]), np.concatenate([np.full(len(p), float(g)) for p, g in phases])


def starting(batch):
    """The shared batch with the cubes at ``PLACES``, far from its time-out."""
    state = batch.reset(0)
    sim, carry = state.pipeline_state, state.info["carry"]
    sim = sim.replace(qpos=sim.qpos.at[:, 9:11].set(jnp.array(PLACES, jnp.float32)))
    carry = carry.replace(step=jnp.full_like(carry.step, -10_000))
    return state.replace(pipeline_state=sim, info={**state.info, "carry": carry})


def on_native(batch, script):
    """As a policy would, by actions."""
    state, home, frames = starting(batch), np.array(batch.env.cfg.robot.arm.home), []
    for arm, grip in zip(*script, strict=True):
        action = np.concatenate([(arm - home) / batch.env.cfg.actions["arm"].params["scale"], np.full((8, 1), grip)], axis=1)
        state = batch.step(state, action)
        assert not state.done.any()
        frames.append(state.pipeline_state)
    assert batch.traces == 1
    # The package's own idea of a grasp, too.
    assert np.isfinite(state.info["carry"].memory["metrics.grasp_time"]).all() == (script[1].min() < 0)
    return frames


def on_mjx(batch, script, step):
    """The drives' targets by hand."""
    gripper, sim, frames = batch.env.cfg.robot.gripper, starting(batch).pipeline_state, []
    for arm, grip in zip(*script, strict=True):
        fingers = np.tile(gripper.open if grip > 0 else gripper.close, (8, 1))
        ctrl = np.asarray(sim.ctrl)
        ctrl = ctrl + np.clip(np.concatenate([arm, fingers], axis=1) - ctrl, -0.03, 0.03)  # 1.5 rad/s, 1.5 m/s
        sim = step(sim, ctrl.astype(np.float32))
        frames.append(sim)
    return frames


@dataclasses.dataclass
class Grip:
    """What the last second showed, by place."""

    height: np.ndarray  # of the cube, the least
    ee_height: np.ndarray
    offset: np.ndarray  # [steps, place, 3] of the cube in the gripper's frame
    depth: np.ndarray  # to which pads and cube overlap, the most
    speed: np.ndarray  # of the cube, the most

    @classmethod
    def measure(cls, model, frames):
        data, offset, depth = mujoco.MjData(model), [], np.zeros(8)
        frames = jax.tree.map(lambda *x: np.stack(x), *frames[-HELD:])
        ee_height = np.zeros(8)
        for t in range(HELD):
            row = []
            for i in range(8):
                data.qpos[:], data.qvel[:] = frames.qpos[t, i], 0
                mujoco.mj_forward(model, data)
                site = data.site("ee")
                row.append(site.xmat.reshape(3, 3).T @ (data.body("cube").xpos - site.xpos))
                pads = {frozenset(model.geom(g).name for g in pair) for pair in data.contact.geom}
                assert pads == {frozenset(("pad1", "cube")), frozenset(("pad2", "cube"))}  # held by both pads, by nothing else
                depth[i] = max(depth[i], -data.contact.dist.min())
                ee_height[i] = site.xpos[2]
            offset.append(row)
        speed = np.linalg.norm(frames.qvel[:, :, 9:12], axis=-1).max(0)
        return cls(frames.qpos[:, :, 11].min(0), ee_height, np.array(offset), depth, speed)


@pytest.mark.parametrize("backend", ["native", "mjx"])
def test_scripted_grasp_lifts_and_holds(batch, script, backend, request):
    frames = on_native(batch, script) if backend == "native" else on_mjx(batch, script, request.getfixturevalue("mjx_step"))
    grip = Grip.measure(batch.env.physics_model, frames)
    assert (grip.height > 0.2).all()
    np.testing.assert_allclose(grip.ee_height, ASCENT[-1], atol=0.02)
    assert np.linalg.norm(grip.offset, axis=-1).max() < 5e-3
    creep = np.linalg.norm(grip.offset[-1] - grip.offset[0], axis=-1) / (0.02 * (HELD - 1))
    assert creep.max() < 1e-3  # m/s
    assert grip.depth.max() < 1e-3
    assert grip.speed.max() < 0.02


def test_without_closing_nothing_is_lifted(batch, script):
    """The counter-check: the same path with open fingers leaves the cubes on the table."""
    arm, grip = script
    frames = on_native(batch, (arm, np.ones_like(grip)))
    height = np.asarray(frames[-1].qpos)[:, CUBE][:, 2]
    assert (height < 0.02).all()
