"""Shows what an environment's cameras see, as a sheet of pictures, and how much of the objects they see, as a table."""

import dataclasses
from typing import Any

import jax
import numpy as np

from mjx_nero.envs.env import ManipulationEnv
from mjx_nero.envs.task import EnvCfg
from mjx_nero.mdp.images import Lens
from mjx_nero.runs import console
from mjx_nero.sim.cameras import places

WORLDS = 32
_STEPS, _EVERY = 40, 40  # control steps with random actions; steps between two pictures
_COLUMNS = 8
_EDGE = 128  # approximate size of a picture on the sheet [pixels]


@dataclasses.dataclass(frozen=True)
class Seen:
    """Pictures of random states.

    Attributes:
        pictures: ``types.Picture`` by camera, [states, ...], in numpy.
        shares: (camera, object) -> share of states in which the object is visible, and its mean number of pixels.
    """

    pictures: dict[str, Any]
    shares: dict[tuple[str, str], tuple[float, float]]


def see(cfg: EnvCfg) -> Seen:
    """Draws states of random episodes through the task's cameras, or through default cameras for its robot if it has none.

    Raises:
        UserError: the robot does not declare a workspace, or this machine cannot draw.
    """
    found = cfg.scene.cameras or places.find(cfg.robot)
    found = {name: dataclasses.replace(c, kinds=tuple({*c.kinds, "rgb", "segmentation"})) for name, c in found.items()}
    # Without observations or lenses that use pictures, steps draw none.
    told = {name: group for name, group in cfg.observations.items() if not group.apart}
    sensors = {name: term for name, term in cfg.sensors.items() if not isinstance(term.made, Lens)}
    seen = dataclasses.replace(cfg.scene, cameras=found)
    cfg = dataclasses.replace(cfg, scene=seen, observations=told, sensors=sensors)
    env = ManipulationEnv(cfg, impl="native", num_envs=WORLDS)
    step, draw = jax.jit(jax.vmap(env.step)), jax.jit(jax.vmap(lambda state: env.view(state).cameras))
    state, shots = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), WORLDS)), []
    aim: Any = None
    for i in range(_STEPS + 1):
        if i % _EVERY == 0:
            aim = env.home_action + jax.random.uniform(jax.random.PRNGKey(i), (WORLDS, env.action_size), minval=-0.5, maxval=0.5)
            shots.append(jax.device_get(draw(state)))
        state = step(state, aim)
    pictures: dict[str, Any] = jax.tree.map(lambda *x: np.concatenate(x), *shots)
    shares = {}
    for camera, picture in pictures.items():
        for name in cfg.scene.objects:
            count = (picture.segmentation == env.mj_model.geom(name).id).sum((1, 2))
            shares[camera, name] = float((count > 0).mean()), float(count.mean())
    return Seen(pictures, shares)


def sheet(seen: Seen) -> np.ndarray:
    """Puts all colour pictures on one sheet, uint8 [height, width, 3], camera by camera."""
    rows = []
    for picture in seen.pictures.values():
        times = max(1, _EDGE // max(picture.rgb.shape[1:3]))
        large = picture.rgb.repeat(times, 1).repeat(times, 2)
        large = np.pad(large, ((0, 0), (0, 4), (0, 4), (0, 0)), constant_values=255)
        rows += [np.concatenate(list(large[at : at + _COLUMNS]), axis=1) for at in range(0, len(large), _COLUMNS)]
    width = max(row.shape[1] for row in rows)
    return np.concatenate([np.pad(r, ((0, 0), (0, width - r.shape[1]), (0, 0)), constant_values=255) for r in rows])


def table(seen: Seen) -> console.Table:
    """Makes a table of how much the cameras see."""
    view = console.Table("cameras", ("camera", "pixels", "object", "seen in", "pixels of it"), left=("camera", "object"))
    for (camera, name), (share, count) in seen.shares.items():
        height, width = seen.pictures[camera].rgb.shape[1:3]
        view.add(camera, f"{width} x {height}", name, f"{share:.0%} of states", f"{count:.1f}")
    return view
