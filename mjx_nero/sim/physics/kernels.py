"""Warp kernels, made from sources in this folder and compiled side by side."""

from collections.abc import Callable, Iterable, Mapping
from importlib import resources
from typing import Any

import numpy as np


def make(
    name: str, constants: Mapping[str, int | Iterable[int]], values: Mapping[str, Any], n: int, threads: int = 1
) -> Callable[[], None]:
    """Makes a function that runs a source of this folder, with ``threads`` threads for each of ``n`` environments.

    Args:
        name: name of the source, without ``.cu``: the body of a function of (tid, problem).
        constants: integers and tables to compile it with.
        values: the fields of ``problem``: Warp arrays and integers.
    """
    import warp as wp

    types: dict[str, Any] = {
        key: int if isinstance(x, int) else wp.array(dtype=x.dtype, ndim=x.ndim) for key, x in values.items()
    }
    Problem = wp.struct(type("Problem", (), {"__annotations__": types}))
    problem = Problem()
    for key, x in values.items():
        setattr(problem, key, x)

    @wp.func_native("".join(map(_constant, constants, constants.values())) + source(name))
    def work(tid: int, problem: Problem): ...  # type: ignore[valid-type]

    @wp.kernel(module="unique", enable_backward=False)
    def environments(problem: Problem):  # type: ignore[valid-type]
        work(wp.tid(), problem)

    block = 32 if wp.get_device().is_cuda else 1
    return lambda: wp.launch(environments, dim=n * threads, inputs=[problem], block_dim=block)


def as_jax(function: Callable[..., None], outputs: int) -> Callable[..., Any]:
    """Turns a function of Warp's arrays into a function of JAX's, which XLA calls on the stream that it computes on.

    Graph mode is off, because it would capture the function for every set of addresses that XLA uses. Nothing is loaded while JAX
    traces: another thread may be adding kernels to the same module, and then the load ends with a KeyError.

    Args:
        function: takes arrays, annotated as Warp's; the last ``outputs`` of them are written.
    """
    import warp as wp

    return wp.jax_callable(
        function,
        num_outputs=outputs,
        vmap_method=None,
        graph_mode=wp.JaxCallableGraphMode.NONE,
        module_preload_mode=wp.JaxModulePreloadMode.NONE,
    )


def source(name: str) -> str:
    """The text of a source of this folder."""
    return resources.files(__package__).joinpath(f"{name}.cu").read_text()


def load(work: Callable[[], None]) -> None:
    """Compiles all kernels that ``work`` would launch on the current device, side by side, and launches nothing.

    Warp compiles a kernel at its first launch, so a first call of ``work`` would compile them one after another. Whole modules of
    MuJoCo Warp hold many kernels that no model here needs.
    """
    import warp as wp

    found: dict[int, dict[Any, None]] = {}  # by block size, in order
    launch, launch_tiled = wp.launch, wp.launch_tiled

    def note(kernel: Any, dim: Any = (), *args: Any, block_dim: int = 256, **kwargs: Any) -> None:
        if np.prod(dim) and not kernel.is_generic:
            found.setdefault(block_dim, {})[kernel.module] = None

    wp.launch = wp.launch_tiled = note  # type: ignore[assignment]
    try:
        work()
    finally:
        wp.launch, wp.launch_tiled = launch, launch_tiled
    for block_dim, modules in found.items():
        wp.force_load(wp.get_device(), list(modules), block_dim=block_dim, max_workers=len(modules))


def _constant(name: str, value: int | Iterable[int]) -> str:
    if isinstance(value, int):
        return f"constexpr int {name} = {value};\n"
    return f"static constexpr int {name}[] = {{{', '.join(str(int(x)) for x in value) or '0'}}};\n"
