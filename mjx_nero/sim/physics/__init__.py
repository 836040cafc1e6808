"""Physics backends: one control step of a batch of environments, on whatever this machine has.

Each is a module of its own with one class; ``make_physics`` picks by name. All give the terms the same state, ``types.Sim``.
"""

import contextlib
import dataclasses
import importlib
import os
from collections.abc import Callable, Iterator, Sequence
from typing import Protocol, runtime_checkable

import jax
import mujoco
from jaxtyping import Array, Float

from mjx_nero.sim.scene import SimCfg
from mjx_nero.types import Sim, UserError


@dataclasses.dataclass(frozen=True)
class Footprint:
    """What a backend takes of a device's memory for an environment [bytes].

    Attributes:
        in_program: of JAX's, in a compiled step.
        outside: of its own, beside JAX's; and what there is ``free`` for that on each device.
    """

    in_program: float = 0.0
    outside: float = 0.0
    free: float = float("inf")


@runtime_checkable
class Physics(Protocol):
    """A compiled model, stepped at control rate."""

    @property
    def compiler_options(self) -> dict[str, str | bool]:
        """Options of ``jax.jit`` to train with this physics."""
        ...

    def step(self, sim: Sim, ctrl: Float[Array, "*batch nu"]) -> tuple[Sim, Float[Array, "*batch"]]:
        """One control step (``decimation`` physics steps); pure, for one environment or vmapped for many.

        Returns:
            the state, and 1.0 if contacts or constraint rows were lost for want of buffer (Warp only), else 0.0.
        """
        ...

    def prepare(self, num_envs: int, num_devices: int = 1) -> None:
        """Makes ready what ``step`` needs for so many environments on each of the first devices; it may be called in a thread.

        ``step`` would do it, too, but inside a JAX program, and for as long as that runs XLA's autotuner lets no other program
        for that device be compiled.
        """
        ...

    def memory(self, num_devices: int = 1) -> Footprint:
        """What an environment takes of each of the first devices."""
        ...


# (model from ``scene.build(..., visuals=False, fuse=True)``, options and buffer sizes, fields that differ from world to world)
Make = Callable[[mujoco.MjModel, SimCfg, Sequence[str]], Physics]


def _own(module: str, name: str) -> Make:
    return lambda *args: getattr(importlib.import_module(f"mjx_nero.sim.physics.{module}"), name)(*args)


_BACKENDS: dict[str, Make] = {
    "warp": _own("mujoco_warp", "WarpPhysics"),
    "jax": _own("mjx", "JaxPhysics"),
    "native": _own("native", "NativePhysics"),
}


def impls() -> tuple[str, ...]:
    """The names that ``--impl`` takes."""
    return ("auto", *_BACKENDS)


def register(name: str, make: Make) -> None:
    """Adds a backend.

    Raises:
        UserError: there is one of this name.
    """
    if name in impls():
        raise UserError(f"there is a physics {name!r} already: choose another name")
    _BACKENDS[name] = make


def warp_available() -> bool:
    """True if MJX-Warp is installed and JAX runs on an NVIDIA GPU."""
    import mujoco.mjx.warp as mjxw

    return bool(mjxw.WARP_INSTALLED) and jax.default_backend() == "gpu"


def resolve_impl(impl: str) -> str:
    """``auto`` -> the fastest that this machine has; checks the others.

    Raises:
        UserError: unknown, or not possible on this machine.
    """
    if impl not in impls():
        raise UserError(f"unknown impl {impl!r}: choose one of {', '.join(impls())}")
    if impl == "auto":
        return "warp" if warp_available() else "native" if jax.default_backend() == "cpu" else "jax"
    if impl == "warp" and not warp_available():
        raise UserError("impl 'warp' needs an NVIDIA GPU and the cuda extra (pip install -e '.[cuda]'): use --impl auto here")
    return impl


def make_physics(model: mujoco.MjModel, cfg: SimCfg, impl: str, fields: Sequence[str] = ()) -> Physics:
    """The backend of a name that ``resolve_impl`` gave.

    Args:
        model: from ``scene.build(..., visuals=False, fuse=True)``.
        cfg: options and buffer sizes.
        fields: names of the model's fields that ``Sim.fields`` brings for every world.

    Raises:
        UserError: the backend cannot compute this model.
    """
    return _BACKENDS[impl](model, cfg, fields)


def fusion() -> dict[str, str | bool]:
    """The compiler options of a backend that is no JAX program itself.

    With an old JAX the package switches off a fusion of XLA's that MJX-JAX and the controllers cannot do with (see
    ``mjx_nero/__init__.py``). Networks take half as long again without it, so for them it comes back where MJX-JAX is not.
    """
    switch = "xla_cpu_use_fusion_emitters"
    return {switch: True} if f"{switch}=false" in os.environ.get("XLA_FLAGS", "") else {}


@contextlib.contextmanager
def possible(name: str) -> Iterator[None]:
    """Says in one line what a backend cannot do with a model.

    Raises:
        UserError: in place of the library's own errors.
    """
    try:
        yield
    except (NotImplementedError, ValueError) as error:
        raise UserError(f"{name} cannot compute this scene: {' '.join(map(str, error.args))}") from error
