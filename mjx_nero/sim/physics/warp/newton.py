"""MuJoCo's Newton solver for constraint forces, as one GPU kernel.

MuJoCo Warp solves with a dozen kernels per iteration, each for all environments, until the slowest of them has converged. With
thousands of environments that is most of a step with a grasp. Here a block of 32 threads solves one environment from beginning to
end, in shared memory. The Jacobian is there only if it is dense, as in MuJoCo Warp up to 32 degrees of freedom. The problem is
MuJoCo's own (mujoco.readthedocs.io, Computation, "Primal problem": the accelerations that minimise Gauss' cost and the
constraints' cost, with elliptic or pyramidal friction cones), so the solution is, too.

The source, ``newton.cu``, compiles for the CPU as well, with one thread for all 32: slow, for tests.
"""

import math
from collections.abc import Callable
from typing import Any

import mujoco

from mjx_nero.sim.physics.warp import kernels

_SHARED_BYTES = 48 * 1024  # shared memory of a block, on every GPU that Warp supports
_DOFS = 64  # one bit each


def floats(nv: int, njmax: int, dense: bool) -> int | None:
    """Numbers that an environment takes in shared memory; None: the model is too large."""
    stride, pairs = (nv + 1) | 1, nv * (nv + 1) // 2
    size = nv * (stride + 5) + njmax * (7 + dense * nv) + math.ceil((2 * pairs + nv) / 4)
    return size if nv <= _DOFS and 4 * size <= _SHARED_BYTES else None


def fits(model, data) -> bool:
    """True if the kernel can solve for this model; otherwise MuJoCo Warp's own solver does."""
    return floats(model.nv, data.njmax, not model.is_sparse) is not None


def make(model, data) -> Callable[[], None]:
    """Makes a function that writes the solution to ``data.qacc`` and ``data.efc.Ma``: all that MuJoCo Warp's integrators read.

    If the model has sensors, it also writes the contacts' forces to ``data.efc.force``.

    Args:
        model, data: MuJoCo Warp's model and data.

    Returns:
        A function without arguments. It calls MuJoCo Warp's own solver if the model is too large for this one.
    """
    import warp as wp
    from mujoco.mjx.third_party import mujoco_warp

    nv, njmax, dense = model.nv, data.njmax, not model.is_sparse
    size = floats(nv, njmax, dense)
    if size is None:
        return lambda: mujoco_warp.solve(model, data)
    numbers = {"NV": nv, "NJ": njmax, "DENSE": int(dense), "SIZE": size}
    numbers["ELLIPTIC"] = int(mujoco.mjtConstraint.mjCNSTR_CONTACT_ELLIPTIC)
    numbers["FORCES"] = int(model.nsensordata > 0)  # only sensors use them
    arrays: dict[str, Any] = {name: getattr(data, name) for name in ("nefc", "ne", "nf", "M", "qfrc_smooth", "qacc_warmstart")}
    arrays |= {f"efc_{name}": getattr(data.efc, name) for name in ("J", "D", "aref", "frictionloss", "type", "id", "Ma", "force")}
    arrays |= {f"efc_J_{name}": getattr(data.efc, f"J_{name}") for name in ("rownnz", "rowadr", "colind")}
    arrays |= {f"contact_{name}": getattr(data.contact, name) for name in ("friction", "dim", "efc_address")}
    arrays |= {name: getattr(model, name) for name in ("M_rownnz", "M_rowadr", "M_colind")}
    arrays |= {name: getattr(model.opt, name) for name in ("impratio_invsqrt", "tolerance", "ls_tolerance")}
    arrays |= {"qacc": data.qacc, "solver_niter": data.solver_niter}
    arrays |= {"iterations": int(model.opt.iterations), "ls_iterations": int(model.opt.ls_iterations)}
    return kernels.make("newton", numbers, arrays, data.nworld, threads=32 if wp.get_device().is_cuda else 1)
