"""Warp kernels, made from sources in this folder and compiled side by side."""

import functools
import threading
from collections.abc import Callable, Iterable, Mapping
from importlib import resources
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

# Warp's current device belongs to the process, not to a thread. Hold this lock while changing it, so that no other thread
# makes anything meanwhile: a kernel whose arrays are on another device crashes the process.
WARP = threading.Lock()


def make(
    names: Iterable[str],
    constants: Mapping[str, int | Iterable[int]],
    values: Mapping[str, Any],
    n: int,
    threads: int = 1,
    resident: int = 0,
    block: int = 32,
) -> Callable[[], None]:
    """Makes a function that runs sources of this folder, with ``threads`` threads for each of ``n`` environments.

    Args:
        names: names of the sources, without ``.cu``: one after another the body of a function of (tid, problem).
        constants: integers and tables to compile it with.
        values: the fields of ``problem``: Warp arrays and integers.
        resident: blocks that a multiprocessor should have registers for; 0: the compiler decides.
        block: threads of a block.
    """
    import warp as wp

    Problem, problem = packed("Problem", values)

    source = "".join(resources.files(__package__).joinpath(f"{name}.cu").read_text() for name in names)

    @wp.func_native("".join(map(_constant, constants, constants.values())) + source)
    def work(tid: int, problem: Problem): ...  # type: ignore[valid-type]

    @wp.kernel(module="unique", enable_backward=False, launch_bounds=(block, resident) if resident else None)
    def environments(problem: Problem):  # type: ignore[valid-type]
        work(wp.tid(), problem)

    size = block if wp.get_device().is_cuda else 1
    return lambda: wp.launch(environments, dim=n * threads, inputs=[problem], block_dim=size)


def packed(name: str, values: Mapping[str, Any]) -> tuple[Any, Any]:
    """Packs integers and arrays into one kernel argument. Returns its type, called ``name``, and its value."""
    import warp as wp

    types: dict[str, Any] = {
        key: int if isinstance(x, int) else wp.array(dtype=x.dtype, ndim=x.ndim) for key, x in values.items()
    }
    Packed = wp.struct(type(name, (), {"__annotations__": types}))
    made = Packed()
    for key, x in values.items():
        setattr(made, key, x)
    return Packed, made


def as_jax(function: Callable[..., None], outputs: int, key: str = "") -> tuple[Callable[..., Any], str]:
    """Turns a function of Warp's arrays into a function of JAX's, which XLA calls on the stream that it computes on.

    Graph mode is off, because it would capture the function for every set of addresses that XLA uses. Nothing is loaded while JAX
    traces: another thread may be adding kernels to the same module, and then the load ends with a KeyError.

    Args:
        function: takes arrays, annotated as Warp's, of float32 up to the last ``outputs`` of them, which are written.
        key: identifies what ``function`` does, in this process and in others. A process calls this once for each key.

    Returns:
        JAX's function, and the name of its operation, which follows from the function's name and the key.
    """
    import warp as wp

    function.__qualname__ = f"{function.__name__}_{key}"
    call = wp.jax_callable(
        function,
        num_outputs=outputs,
        vmap_method=None,
        graph_mode=wp.JaxCallableGraphMode.NONE,
        module_preload_mode=wp.JaxModulePreloadMode.NONE,
    )
    one_by_one = threading.Lock()

    def numbered(*inputs: Any, output_dims: Mapping[str, tuple[int, ...]]) -> Any:
        # Warp numbers the calls as JAX traces them, and looks the number up when one runs. All are number 0, so that programs are
        # the same in every process, and run in one that has not traced them.
        with one_by_one:
            call.call_id = 0
            return call(*inputs, output_dims=output_dims)

    ones = {name: (1,) * array.ndim for name, array in function.__annotations__.items()}
    inputs = [jax.ShapeDtypeStruct(shape, np.float32) for shape in ones.values()]
    jax.eval_shape(functools.partial(numbered, output_dims=ones), *inputs[:-outputs])  # so that number 0 is known
    return numbered, call.name


def batched(function: Callable[..., tuple], outputs: int) -> Callable[..., tuple]:
    """Wraps a function of batches: ``jax.vmap`` calls it once, with one more leading axis on all arguments."""
    whole = jax.custom_batching.custom_vmap(function)

    @whole.def_vmap
    def _(size, is_batched, *given):
        wide = (x if own else jnp.broadcast_to(x, (size, *x.shape)) for x, own in zip(given, is_batched, strict=True))
        return whole(*wide), (True,) * outputs

    return whole


class Programs:
    """Kept parts of batches: made by ``make(number of worlds)`` at the first call with that number on a device."""

    def __init__(self, make: Callable[[int], Any]):
        self._make = make
        self._made: dict[tuple[str, int], Any] = {}  # by device and number of worlds

    def __call__(self, n: int) -> Any:
        """Returns the program for ``n`` worlds on Warp's current device."""
        import warp as wp

        key = (str(wp.get_device()), n)
        if key not in self._made:
            self._made[key] = self._make(n)
        return self._made[key]

    def prepare(self, n: int, num_devices: int) -> None:
        """Makes the program on each of the first devices. A thread may call this."""
        import warp as wp

        for device in wp.get_cuda_devices()[:num_devices] or [wp.get_device("cpu")]:
            with WARP, wp.ScopedDevice(device):
                self(n)
                wp.synchronize_device(device)


def captured(run: Callable[[], None]) -> Callable[[], None]:
    """Captures a function's launches in one CUDA graph. Call the function once before: loading kernels cannot be captured."""
    import warp as wp

    with wp.ScopedCapture() as capture:
        run()
    return functools.partial(wp.capture_launch, capture.graph)


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
