"""Physics backends: one control step of a batch of environments, on whatever this machine has.

Each is a module of its own with one class; ``make_physics`` picks. All give the terms the same state, ``types.Sim``.
"""

import os
from typing import Protocol, runtime_checkable

import jax
import mujoco
from jaxtyping import Array, Float

from mjx_nero.scene import SimCfg
from mjx_nero.types import Sim, UserError

IMPLS = ("auto", "warp", "jax", "native")


@runtime_checkable
class Physics(Protocol):
    """A compiled model, stepped at control rate."""

    def step(self, sim: Sim, ctrl: Float[Array, "*batch nu"]) -> tuple[Sim, Float[Array, "*batch"]]:
        """One control step (``decimation`` physics steps); pure, for one environment or vmapped for many.

        Returns:
            the state, and 1.0 if contacts or constraint rows were lost for want of buffer (Warp only), else 0.0.
        """
        ...


def warp_available() -> bool:
    """True if MJX-Warp is installed and JAX runs on an NVIDIA GPU."""
    import mujoco.mjx.warp as mjxw

    return bool(mjxw.WARP_INSTALLED) and jax.default_backend() == "gpu"


def resolve_impl(impl: str) -> str:
    """``auto`` -> the fastest that this machine has; checks the others.

    Raises:
        UserError: unknown, or not possible on this machine.
    """
    if impl not in IMPLS:
        raise UserError(f"unknown impl {impl!r}: choose one of {', '.join(IMPLS)}")
    if impl == "auto":
        return "warp" if warp_available() else "native" if jax.default_backend() == "cpu" else "jax"
    if impl == "warp" and not warp_available():
        raise UserError("impl 'warp' needs an NVIDIA GPU and the cuda extra (pip install -e '.[cuda]'): use --impl auto here")
    return impl


def compiler_options(impl: str) -> dict[str, str | bool]:
    """Options of ``jax.jit`` to train with this physics.

    With an old JAX the package switches off a fusion of XLA's that MJX-JAX and the controllers cannot do with (see
    ``mjx_nero/__init__.py``). Networks take half as long again without it, so for them it comes back where MJX-JAX is not.
    """
    switch = "xla_cpu_use_fusion_emitters"
    return {switch: True} if impl != "jax" and f"{switch}=false" in os.environ.get("XLA_FLAGS", "") else {}


def make_physics(model: mujoco.MjModel, cfg: SimCfg, impl: str) -> Physics:
    """The backend of a name that ``resolve_impl`` gave.

    Args:
        model: from ``scene.build(..., visuals=False, fuse=True)``.
        cfg: options and buffer sizes.
    """
    if impl == "warp":
        from mjx_nero.physics.mjx_warp import WarpPhysics

        return WarpPhysics(model, cfg)
    if impl == "native":
        from mjx_nero.physics.native import NativePhysics

        return NativePhysics(model, cfg)
    from mjx_nero.physics.mjx_jax import JaxPhysics

    return JaxPhysics(model, cfg)
