"""Physics backends: each computes one control step of a batch of environments.

A backend is one module or folder with one class; ``make_physics`` picks it by name. All backends give the terms the same
``types.Sim``.
"""

import contextlib
import dataclasses
import hashlib
import importlib.util
import os
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Protocol, runtime_checkable

import jax
import mujoco
import numpy as np
from jaxtyping import Array, Float

from mjx_nero.config import values
from mjx_nero.config.registry import Registry
from mjx_nero.sim.scene import SimCfg
from mjx_nero.types import Sim, UserError


@dataclasses.dataclass(frozen=True)
class Footprint:
    """Device memory that a backend needs for one environment [bytes].

    Attributes:
        in_program: JAX's memory, in a compiled step.
        outside: the backend's own memory, besides JAX's.
        free: memory available for ``outside`` on each device.
    """

    in_program: float = 0.0
    outside: float = 0.0
    free: float = float("inf")


@runtime_checkable
class Physics(Protocol):
    """A compiled model, stepped at control rate.

    Attributes:
        operations: names of the custom operations in its programs, if they mean the same in every process that has made an equal
            physics. May be missing: then the programs are not kept between runs.
    """

    @property
    def compiler_options(self) -> dict[str, str | bool]:
        """Options of ``jax.jit`` to train with this physics."""
        return fusion()

    def step(self, sim: Sim, ctrl: Float[Array, "*batch nu"]) -> tuple[Sim, Float[Array, "*batch"]]:
        """Computes one control step (``decimation`` physics steps). Pure; takes one environment, vmap it for many.

        Returns:
            the state, and 1.0 if a full buffer lost contacts or constraint rows (Warp only), else 0.0.
        """

    def prepare(self, num_envs: int, num_devices: int = 1) -> None:
        """Prepares what ``step`` needs for ``num_envs`` environments on each of the first devices. A thread may call it.

        ``step`` would prepare it, too, but inside a JAX program; while that runs, XLA's autotuner lets no other program for the
        device compile.
        """

    def footprint(self, num_devices: int = 1) -> Footprint:
        """Returns the memory that one environment needs on each of the first devices."""


# (model from ``scene.build(..., visuals=False, fuse=True)``, options and buffer sizes, fields that differ between worlds)
Make = Callable[[mujoco.MjModel, SimCfg, Sequence[str]], Physics]


def _own(module: str, name: str) -> Make:
    return lambda *args: getattr(importlib.import_module(f"mjx_nero.sim.physics.{module}"), name)(*args)


BACKENDS: Registry[Make] = Registry(
    "physics",
    {
        "auto": lambda *args: BACKENDS[resolve_impl("auto")](*args),
        "warp": _own("warp.mujoco_warp", "WarpPhysics"),
        "jax": _own("mjx", "JaxPhysics"),
        "native": _own("native", "NativePhysics"),
    },
)


def impls() -> tuple[str, ...]:
    """Lists the names that ``--impl`` takes."""
    return tuple(BACKENDS)


def warp_available() -> bool:
    """True if MJX-Warp is installed and JAX runs on an NVIDIA GPU."""
    return importlib.util.find_spec("warp") is not None and jax.default_backend() == "gpu"


def resolve_impl(impl: str) -> str:
    """Turns ``auto`` into the fastest backend of this machine and checks other names.

    Raises:
        UserError: the name is unknown, or this machine cannot run the backend.
    """
    if not isinstance(impl, str) or impl not in impls():
        raise UserError(f"unknown impl {values.short(impl)}: choose one of {', '.join(impls())}")
    if impl == "auto":
        return "warp" if warp_available() else "native" if jax.default_backend() == "cpu" else "jax"
    if impl == "warp" and not warp_available():
        raise UserError("impl 'warp' needs an NVIDIA GPU and the cuda extra (pip install 'mjx-nero[cuda]'): use --impl auto here")
    return impl


def make_physics(model: mujoco.MjModel, cfg: SimCfg, impl: str, fields: Sequence[str] = ()) -> Physics:
    """Makes the backend that ``resolve_impl`` named.

    Args:
        model: from ``scene.build(..., visuals=False, fuse=True)``.
        cfg: options and buffer sizes.
        fields: names of the model fields that ``Sim.fields`` holds for every world.

    Raises:
        UserError: the backend cannot compute this model.
    """
    return BACKENDS[impl](model, cfg, fields)


def identity(model: mujoco.MjModel, *settings: Any) -> bytes:
    """Returns 32 bytes that identify a model and settings, whose ``repr`` tells all of them, in this process and in others."""
    whole = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, whole)
    return hashlib.sha256(whole.tobytes() + repr(settings).encode()).digest()


def fusion() -> dict[str, str | bool]:
    """Compiler options of a backend that is not a JAX program itself.

    With an old JAX the package switches off a fusion of XLA that breaks MJX-JAX and the controllers (see
    ``mjx_nero/__init__.py``). Networks run 1.5 times as long without it, so backends other than MJX-JAX switch it on again.
    """
    switch = "xla_cpu_use_fusion_emitters"
    return {switch: True} if f"{switch}=false" in os.environ.get("XLA_FLAGS", "") else {}


@contextlib.contextmanager
def possible(name: str) -> Iterator[None]:
    """Turns a library's errors about a model into one line.

    Raises:
        UserError: the backend cannot compute the model.
    """
    try:
        yield
    except (NotImplementedError, ValueError) as error:
        raise UserError(f"{name} cannot compute this scene: {' '.join(map(str, error.args))}") from error
