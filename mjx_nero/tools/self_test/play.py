"""Plays a controller in MuJoCo's C library, without the rest of an environment, which takes longer to compile."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from mjx_nero.control.controller import Controller
from mjx_nero.envs.task import EnvCfg
from mjx_nero.envs.view import Viewer
from mjx_nero.sim import linkage, scene
from mjx_nero.sim.physics.native import quiet
from mjx_nero.types import Carry, Sim, View

Watch = Callable[[Any, View], dict[str, Array]]


def play(
    cfg: EnvCfg,
    controller: Controller,
    steps: int,
    places: Mapping[str, Float[np.ndarray, "n 2"]],
    goals: Float[np.ndarray, "n 3"],
    watch: Watch,
) -> dict[str, np.ndarray]:
    """Plays several tries side by side, starting from home.

    Args:
        steps: number of control steps.
        places: object -> its positions on the table, in the world [m].
        goals: fixed goals in the robot's frame [m].
        watch: (controller's memory, view) -> what to keep of each control step.

    Returns:
        what was watched, [steps, n, ...]. A try that became non-finite has NaN, False or 0 from then on.
    """
    model = scene.build(cfg.robot, cfg.scene, cfg.sim, visuals=False)
    command, parts = dataclasses.replace(cfg.command, motion=None), scene.parts(cfg.scene, model)
    viewer = Viewer(model, cfg.robot, parts, steps, cfg.sim.dt * cfg.sim.decimation, command)
    n, still = len(goals), jnp.zeros(model.nu)
    data = [_start(model, cfg, {name: at[i] for name, at in places.items()}) for i in range(n)]
    carry = Carry(
        rng=jnp.zeros((n, 2), jnp.uint32),
        step=jnp.zeros(n, jnp.int32),
        action=jnp.zeros((n, model.nu)),
        command=jnp.asarray(goals, jnp.float32),
        command_quat=jnp.tile(jnp.array(cfg.robot.down), (n, 1)),
        memory={},
    )

    @jax.jit
    @jax.vmap
    def act(memory: Any, sim: Sim, carry: Carry) -> tuple[Any, Array, dict[str, Array]]:
        view = viewer(sim, carry, still)
        after, targets = controller.step(memory, view)
        return after, targets, watch(memory, view)

    start = jax.jit(jax.vmap(lambda sim, carry: controller.init(viewer(sim, carry, still))))
    memory, kept = start(_sim(data), carry), []
    with quiet():
        for step in range(steps):
            memory, targets, seen = act(memory, _sim(data), dataclasses.replace(carry, step=jnp.full(n, step, jnp.int32)))
            kept.append(seen)
            for one, ctrl in zip(data, np.asarray(targets), strict=True):
                one.ctrl[:] = ctrl
                mujoco.mj_step(model, one, cfg.sim.decimation)
    return {name: np.stack([np.asarray(seen[name]) for seen in kept]) for name in kept[0]}


def _start(model: mujoco.MjModel, cfg: EnvCfg, places: Mapping[str, Float[np.ndarray, "2"]]) -> mujoco.MjData:
    """Returns the robot at home with its linkages closed, and the objects in their places."""
    data = mujoco.MjData(model)
    for joint, position in zip(cfg.robot.joints, cfg.robot.home, strict=True):
        data.joint(joint).qpos = position
    linkage.close(linkage.couplings(model), data.qpos)
    for name, place in places.items():
        data.joint(name).qpos[:2] = place
    data.ctrl[:] = cfg.robot.home
    return data


def _sim(data: list[mujoco.MjData]) -> Sim:
    """Returns the states of all tries, NaN for a try that MuJoCo had to reset."""
    lost = np.array([any(w.number for w in one.warning) for one in data])
    qpos, qvel, ctrl = (jnp.asarray([getattr(one, name) for one in data], jnp.float32) for name in ("qpos", "qvel", "ctrl"))
    qpos = jnp.where(lost[:, None], jnp.nan, qpos)
    return Sim(qpos=qpos, qvel=qvel, ctrl=ctrl, warmstart=jnp.zeros_like(qvel), time=jnp.zeros(len(data)))
