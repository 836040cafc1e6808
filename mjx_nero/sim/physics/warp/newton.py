"""MuJoCo's Newton solver for constraint forces, as one GPU kernel.

MuJoCo Warp solves with a dozen kernels per iteration, each for all environments, until the slowest of them has converged. With
thousands of environments that is most of a step with a grasp. Here a block of 32 threads solves one environment from beginning to
end, in registers and shared memory. The problem is MuJoCo's own (mujoco.readthedocs.io, Computation, "Primal problem": the
accelerations that minimise Gauss' cost and the constraints' cost, with elliptic or pyramidal friction cones). So is the solution.

The sources compile for the CPU as well, with one thread for all 32: slow, for tests.
"""

from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np

from mjx_nero.sim.physics.warp import engine, kernels

_SHARED_BYTES = 48 * 1024  # shared memory of a block, on every GPU that Warp supports
_DOFS = 64  # one bit each
_RESIDENT, _ENOUGH = 20, 11_000  # blocks on a multiprocessor, if each takes no more of its shared memory than that [bytes]


def near(njmax: int, dense: bool) -> int:
    """Rows of the Jacobian in shared memory, or nonzeros if it is sparse.

    Buffers are for the worst case: a lift has 128 rows, and hardly ever uses more than 50. An environment that uses more than
    these reads its Jacobian where MuJoCo Warp has it.
    """
    return max(56, njmax // 3) if dense else 768


def floats(nv: int, njmax: int, dense: bool) -> int | None:
    """Numbers that an environment takes in shared memory; None: the model is too large."""
    quads, rows = (nv + 3) // 4, (njmax + 7) // 8 * 8
    size = 7 * rows + 4 * quads
    if dense:
        size += (nv + near(njmax, dense)) * 4 * (quads | 1) + rows // 2
    else:
        size += (nv * (nv + 1) // 2 + 3) // 4 * 4 + near(njmax, dense) * 5 // 4 + rows + _DOFS // 4
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

    nv, njmax, dense = model.nv, data.njmax, not model.is_sparse
    size = floats(nv, njmax, dense)
    if size is None:
        return lambda: engine.solve(model, data)
    starts, counts, columns = (getattr(model, name).numpy() for name in ("M_rowadr", "M_rownnz", "M_colind"))
    low = columns[starts]  # the first degree of freedom of each one's tree
    numbers: dict[str, Any] = {"NV": nv, "NJ": njmax, "DENSE": int(dense), "ROWS": near(njmax, dense), "SIZE": size}
    numbers |= {"NM": len(columns), "M_ROW": np.repeat(np.arange(nv), counts), "M_COLUMN": columns}
    numbers |= {"LOW": low, "HIGH": np.searchsorted(low, low, "right"), "TREE": int(np.bincount(low).max())}
    numbers["ELLIPTIC"] = int(mujoco.mjtConstraint.mjCNSTR_CONTACT_ELLIPTIC)
    numbers["FORCES"] = int(model.nsensordata > 0)  # only sensors use them
    arrays: dict[str, Any] = {name: getattr(data, name) for name in ("nefc", "ne", "nf", "M", "qfrc_smooth", "qacc_warmstart")}
    arrays |= {f"efc_{name}": getattr(data.efc, name) for name in ("J", "D", "aref", "frictionloss", "type", "id", "Ma", "force")}
    arrays |= {f"efc_J_{name}": getattr(data.efc, f"J_{name}") for name in ("rownnz", "rowadr", "colind")}
    arrays |= {f"contact_{name}": getattr(data.contact, name) for name in ("friction", "dim", "efc_address")}
    arrays |= {name: getattr(model.opt, name) for name in ("impratio_invsqrt", "tolerance", "ls_tolerance")}
    arrays |= {"qacc": data.qacc, "solver_niter": data.solver_niter}
    arrays |= {"iterations": int(model.opt.iterations), "ls_iterations": int(model.opt.ls_iterations)}
    sources = ["newton_rows", "newton_dense" if dense else "newton_sparse", "newton"]
    how = {"threads": 32, "resident": _RESIDENT if 4 * size <= _ENOUGH else 0} if wp.get_device().is_cuda else {}
    return kernels.make(sources, numbers, arrays, data.nworld, **how)
