"""Measures inverse kinematics in poses per second, and compares with the package mink if it is installed."""

import statistics
import time
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from mjx_nero.control import ik
from mjx_nero.sim import scene
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.tools.benchmark.program import Row

_MINK_POSES, _MINK_ITERATIONS = 100, 100


def measure_ik(robot: RobotCfg, sizes: Sequence[int], repeats: int) -> list[Row]:
    """Measures inverse kinematics from the home position to poses of random configurations within the joint limits.

    Each measurement has its own batch, and each batch size solves at least a hundred poses. The last row is mink's, for the
    first hundred of the same poses.
    """
    solver = ik.InverseKinematics(robot)
    counts = {n: max(repeats, -(-_MINK_POSES // n)) for n in sizes}
    lower, upper = solver.chain.lower, solver.chain.upper
    total = max(n * count for n, count in counts.items())
    q = jax.random.uniform(jax.random.PRNGKey(0), (total, len(lower)), minval=lower, maxval=upper)
    pos, quat = (np.asarray(x[:, 0]) for x in jax.jit(jax.vmap(solver.chain.poses))(q))
    rows = []
    for n, count in counts.items():
        home, keys = jnp.tile(jnp.array(robot.arm.home), (n, 1)), jax.random.split(jax.random.PRNGKey(1), count)
        parts = [slice(i * n, (i + 1) * n) for i in range(count)]
        batches = [(jnp.array(pos[part]), jnp.array(quat[part]), home, key) for part, key in zip(parts, keys, strict=True)]
        begun = time.perf_counter()
        compiled = jax.jit(solver.solve_batch).lower(*batches[0]).compile()
        jax.block_until_ready(compiled(*batches[0]))
        compile_s = time.perf_counter() - begun
        seconds, solutions = [], []
        for batch in batches:
            begun = time.perf_counter()
            solutions.append(jax.block_until_ready(compiled(*batch)))
            seconds.append(time.perf_counter() - begun)
        found = jax.tree.map(lambda *x: jnp.concatenate(x), *solutions)
        errors = found.position_error, found.orientation_error
        device = jax.devices()[0].device_kind
        rows.append(_ik_row("mjx_nero", n, seconds, found.success, *errors, compile_s, device))
    return rows + measure_mink(robot, pos[:_MINK_POSES], quat[:_MINK_POSES])


def measure_mink(robot: RobotCfg, pos: np.ndarray, quat: np.ndarray) -> list[Row]:
    """Measures mink's differential inverse kinematics, pose by pose, from the home position to our solver's tolerances."""
    try:
        import mink
    except ImportError:
        print("mink is not installed (pip install mink): no comparison")
        return []
    cfg, model = ik.IkCfg(), scene.robot_model(robot)
    home = model.qpos0.copy()
    home[[model.joint(j).qposadr[0] for j in robot.arm.joints]] = robot.arm.home
    task = mink.FrameTask(robot.ee_site, "site", position_cost=1.0, orientation_cost=cfg.orientation_weight, lm_damping=1e-3)
    limits = [mink.ConfigurationLimit(model)]
    configuration = mink.Configuration(model)
    errors = []
    begun = time.perf_counter()
    for p, r in zip(pos.astype(float), quat.astype(float), strict=True):
        target = mink.SE3.from_rotation_and_translation(mink.SO3(r / np.linalg.norm(r)), p)
        configuration.update(home)
        task.set_target(target)
        for i in range(_MINK_ITERATIONS + 1):
            at = configuration.get_transform_frame_to_world(robot.ee_site, "site")
            position = np.linalg.norm(p - at.translation())
            orientation = np.linalg.norm((at.rotation().inverse() @ target.rotation()).log())
            done = position <= cfg.position_tolerance and orientation <= cfg.orientation_tolerance
            if done or i == _MINK_ITERATIONS:
                break
            configuration.integrate_inplace(mink.solve_ik(configuration, [task], 1.0, "daqp", limits=limits), 1.0)
        errors.append((done, position, orientation))
    seconds = (time.perf_counter() - begun) / len(pos)
    success, position, orientation = np.array(errors).T
    return [_ik_row("mink", 1, [seconds], success, position, orientation, 0.0, "cpu")]


def _ik_row(solver: str, n: int, seconds: list[float], success, position, orientation, compile_s: float, device: str) -> Row:
    middle = statistics.median(seconds)
    return {
        "what": "ik",
        "solver": solver,
        "batch": n,
        "poses": len(success),
        "ms_per_batch": round(1e3 * middle, 3),
        "ms_per_batch_min": round(1e3 * min(seconds), 3),
        "ms_per_batch_max": round(1e3 * max(seconds), 3),
        "solves_per_s": round(n / middle),
        "success": round(float(np.mean(success)), 5),
        "error_mm": round(1e3 * float(np.median(position)), 4),
        "error_mrad": round(1e3 * float(np.median(orientation)), 4),
        "compile_s": round(compile_s, 1),
        "device": device,
    }
