"""MuJoCo Warp's ray tracer: all worlds at once, on an NVIDIA GPU, or on the CPU for tests and small numbers.

As in ``physics.warp``, the arrays stay in Warp: one CUDA graph computes the poses and draws, JAX copies positions in and pictures
out. The function is pure, so pictures that are not used are not drawn.
"""

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Bool

from mjx_nero.sim.cameras import Drawer
from mjx_nero.sim.cameras.cfg import MARK, CameraCfg
from mjx_nero.sim.fields import nominal
from mjx_nero.sim.physics import possible
from mjx_nero.sim.physics.warp import kernels
from mjx_nero.sim.physics.warp.mujoco_warp import world_fields
from mjx_nero.types import Picture

_SEEN = [0, 1, 2]  # geom groups, as MuJoCo's renderer shows them


class RayTracer(Drawer):
    """See ``cameras.Drawer``. The first call with a batch size on a device makes the buffers, which are kept."""

    def __init__(self, model: mujoco.MjModel, cfg: Mapping[str, CameraCfg], fields: Sequence[str]):
        self._model, self._cfg = model, dict(cfg)
        self._fields = {name: np.shape(getattr(model, name)) for name in fields}
        self._pixels = {
            kind: sum(math.prod(c.size) for c in cfg.values() if kind in c.kinds) for kind in ("rgb", "depth", "segmentation")
        }
        self._get = kernels.Programs(self._make)
        self._batched = self._as_jax()
        self._where_due = self._as_jax(sometimes=True)

    def __call__(
        self, qpos: jax.Array, fields: Mapping[str, Array], due: Bool[Array, "*n cameras"] | None = None
    ) -> dict[str, Picture]:
        """Draws the pictures of one world, or of a batch given by leading axes."""
        lead = qpos.shape[:-1]
        given = [qpos, *(_bits(fields[name].reshape(*lead, -1)) for name in self._fields)]
        packed = jnp.concatenate(given, axis=-1) if self._fields else qpos
        rgb, depth, segmentation = self._batched(packed) if due is None else self._where_due(packed, due.any(axis=-1))
        images = {
            "rgb": jnp.stack([(rgb >> shift).astype(jnp.uint8) for shift in (16, 8, 0)], axis=-1),
            "depth": depth,
            "segmentation": segmentation[..., 0],
        }
        out, at = {}, dict.fromkeys(images, 0)
        for name, cfg in self._cfg.items():
            own = {}
            for kind in cfg.kinds:
                first, at[kind] = at[kind], at[kind] + math.prod(cfg.size)
                image = jax.lax.slice_in_dim(images[kind], first, at[kind], axis=len(lead))
                own[kind] = image.reshape(*lead, *cfg.shape, *image.shape[len(lead) + 1 :])
            out[name] = Picture(**own)
        return out

    def prepare(self, num_envs: int, num_devices: int = 1) -> None:
        """See ``cameras.Drawer``."""
        self._get.prepare(num_envs, num_devices)

    def bytes(self) -> int:
        """Returns the size of the pictures, of the poses, and of the tree of bounding boxes."""
        m, sizes = self._model, {"rgb": 4, "depth": 4, "segmentation": 8}
        pictures = sum(size * self._pixels[kind] for kind, size in sizes.items())
        tree = 200 * m.ngeom + 120 * (m.nbody + m.ngeom + m.nsite + m.ncam + m.nlight)
        return pictures + tree + 4 * sum(math.prod(shape) for shape in self._fields.values())

    def _as_jax(self, sometimes: bool = False) -> Callable:
        """Makes the JAX function that draws. ``sometimes``: it also takes which worlds are due, and draws all of them or none."""
        import warp as wp

        # As in ``physics.warp``: XLA calls this function on the stream that it computes on.
        def draw(given, rgb_out, depth_out, segmentation_out):
            data, drawn, seen, run, _ = self._get(given.shape[0])
            nq = data.qpos.shape[1]
            wp.copy(data.qpos, given[:, :nq] if drawn is not None else given)
            if drawn is not None:
                wp.copy(drawn, given[:, nq:])
            run()
            for kind, out, made in (
                ("rgb", rgb_out, seen.rgb_data),
                ("depth", depth_out, seen.depth_data),
                ("segmentation", segmentation_out, seen.seg_data),
            ):
                if self._pixels[kind]:  # otherwise it is not used
                    wp.copy(out, made)

        draw.__annotations__ = {
            "given": wp.array(dtype=float, ndim=2),
            "rgb_out": wp.array(dtype=wp.uint32, ndim=2),
            "depth_out": wp.array(dtype=float, ndim=2),
            "segmentation_out": wp.array(dtype=wp.vec2i, ndim=2),
        }
        call, _ = kernels.as_jax(draw, outputs=3)

        def batched(given, *due):
            lead, rows = given.shape[:-1], given.reshape(-1, given.shape[-1])
            sizes = {f"{kind}_out": (len(rows), max(1, count)) for kind, count in self._pixels.items()}
            drawn = functools.partial(call, output_dims=sizes)
            if not sometimes:
                return tuple(x.reshape(lead + x.shape[1:]) for x in drawn(rows))
            shapes = tuple(jax.eval_shape(drawn, rows))
            found = jax.lax.cond(due[0].any(), lambda x: tuple(drawn(x)), lambda x: jax.tree.map(jnp.zeros_like, shapes), rows)
            return tuple(x.reshape(lead + x.shape[1:]) for x in found)

        return kernels.batched(batched, outputs=3)

    def _make(self, n: int) -> tuple[Any, Any, Any, Callable[[], None], Any]:
        """Makes what ``n`` worlds need on the current device.

        Returns:
            MuJoCo Warp's data, the drawn fields as one array, the pictures, the function that draws, and what must stay alive.
        """
        import warp as wp
        from mujoco.mjx.third_party import mujoco_warp

        with possible("MuJoCo Warp's ray tracer"):
            model = mujoco_warp.put_model(self._model)
            seen = mujoco_warp.create_render_context(
                self._model,
                n,
                cam_active=[MARK + name for name in self._cfg],
                cam_res=[c.size for c in self._cfg.values()],
                render_rgb=["rgb" in c.kinds for c in self._cfg.values()],
                render_depth=["depth" in c.kinds for c in self._cfg.values()],
                render_seg=["segmentation" in c.kinds for c in self._cfg.values()],
                enabled_geom_groups=_SEEN,
                use_precomputed_rays="cam_fovy" not in self._fields,
                render_skybox=True,
                enable_per_light_ambient=False,
                enable_emission=bool(self._model.mat_emission.any()),
            )
        drawn = world_fields(model, self._fields, n)
        data = mujoco_warp.make_data(self._model, n, naconmax=1, njmax=1)
        steps: Sequence[Callable] = (mujoco_warp.kinematics, mujoco_warp.com_pos, mujoco_warp.camlight)

        def run():
            for step in steps:
                step(model, data)
            mujoco_warp.refit_bvh(model, data, seen)
            mujoco_warp.render(model, data, seen)

        if not wp.get_device().is_cuda:  # there are no graphs on a CPU
            return data, drawn, seen, run, model
        if drawn is not None:  # orientations of zero would make no bounding boxes
            given = [np.ravel(x).view(np.float32) for x in nominal(self._model, self._fields).values()]
            drawn.assign(np.tile(np.concatenate(given), (n, 1)))
        run()  # loads the kernels, which cannot be done while a graph is captured
        return data, drawn, seen, kernels.captured(run), (model, run)


def _bits(values: Array) -> Array:
    """The values as bits of floats, where Warp reads integers."""
    return values if jnp.issubdtype(values.dtype, jnp.floating) else jax.lax.bitcast_convert_type(values, jnp.float32)
