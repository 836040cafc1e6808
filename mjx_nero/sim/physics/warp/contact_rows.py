"""The contacts' rows of the constraints, as one GPU kernel.

MuJoCo Warp makes them in three, which read a contact and its bodies' chains again for each row. Here a few threads make all rows
of a contact at once (``contact_rows.cu``). The rows of equalities, of friction in joints and of limits are MuJoCo Warp's.

The source compiles for the CPU as well, for tests.
"""

from collections.abc import Callable, Iterable
from typing import Any

import mujoco
import numpy as np

from mjx_nero.sim.physics.warp import engine, kernels

_CONTACT = "dist includemargin type worldid dim geom pos frame friction solref solreffriction solimp efc_address"
_EFC = "J J_rownnz J_rowadr J_colind D aref frictionloss type id"
_DATA = "nacon nefc cdof subtree_com qvel overflow"
_LANES = 8  # threads of a contact


def make(m: mujoco.MjModel, model: Any, data: Any) -> Callable[[], None]:
    """Makes a function that writes all rows of constraints, as MuJoCo Warp's ``make_constraint`` does.

    It writes what solvers read, not the rows' positions, margins and velocities.

    Args:
        m: a model without features that ``dynamics.missing`` lists, of at most 64 degrees of freedom.
        model, data: MuJoCo Warp's model and data of ``m``.
    """
    import warp as wp

    without = int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    if model.opt.disableflags & (without | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT) or model.flg_adhesion or model.flg_surfacevel:
        return lambda: engine.make_constraint(model, data)
    nonzeros: Any = wp.zeros(data.nworld, dtype=int)
    values = {"nonzeros": nonzeros, "njmax_nnz": int(data.njmax_nnz), "body_invweight0": model.body_invweight0}
    values |= {name: getattr(model.opt, name) for name in ("timestep", "impratio_invsqrt")}
    values |= {f"contact_{name}": getattr(data.contact, name) for name in _CONTACT.split()}
    values |= {f"efc_{name}": getattr(data.efc, name) for name in _EFC.split()}
    values |= {name: getattr(data, name) for name in _DATA.split()}
    how = {"threads": _LANES, "block": 128} if wp.get_device().is_cuda else {}
    contacts = kernels.make(["contact_rows"], _constants(m, model, data), values, data.naconmax, **how)

    def others() -> None:
        flags, model.opt.disableflags = model.opt.disableflags, model.opt.disableflags | without
        engine.make_constraint(model, data)
        model.opt.disableflags = flags

    @wp.kernel(module="unique", enable_backward=False)
    def count(
        nefc: wp.array(dtype=int),  # type: ignore
        njmax: int,
        rowadr: wp.array2d(dtype=int),  # type: ignore
        rownnz: wp.array2d(dtype=int),  # type: ignore
        nonzeros: wp.array(dtype=int),  # type: ignore
    ):
        world = wp.tid()
        end = int(0)  # noqa: UP018 (Warp: a number that a loop changes)
        for row in range(wp.min(nefc[world], njmax)):
            end = wp.max(end, rowadr[world, row] + rownnz[world, row])
        nonzeros[world] = end

    def rows() -> None:
        others()
        if model.is_sparse:
            given = [data.nefc, data.njmax, data.efc.J_rowadr, data.efc.J_rownnz]
            wp.launch(count, dim=data.nworld, inputs=given, outputs=[nonzeros])
        contacts()

    return rows


def _constants(m: mujoco.MjModel, model: Any, data: Any) -> dict[str, int | Iterable[int]]:
    """The sizes and the tables that the source is compiled with."""
    moves = (model.body_isdofancestor.numpy()[m.geom_bodyid, : m.nv] != 0).astype(np.uint64)  # [geoms, dofs]
    masks = (moves << np.arange(m.nv, dtype=np.uint64)).sum(axis=1, dtype=np.uint64).view(np.int32).reshape(-1, 2)
    elliptic = m.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    return {
        "MOVES_LOW": masks[:, 0],
        "MOVES_HIGH": masks[:, 1],
        "ROOT": m.body_rootid[m.dof_bodyid],
        "BODY": m.geom_bodyid,
        "LANES": _LANES,
        "NV": m.nv,
        "NJ": int(data.njmax),
        "MOST": int(model.nmaxcondim if elliptic else model.nmaxpyramid),
        "SPARSE": int(model.is_sparse),
        "ELLIPTIC": int(elliptic),
        "REFSAFE": int(not m.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_REFSAFE),
        "CONSTRAINT": int(engine.ContactType.CONSTRAINT),
        "NJMAX_NNZ": int(engine.OverflowType.NJMAX_NNZ),
        "ALONE": int(mujoco.mjtConstraint.mjCNSTR_CONTACT_FRICTIONLESS),
        "IN_A_CONE": int(mujoco.mjtConstraint.mjCNSTR_CONTACT_ELLIPTIC),
        "IN_A_PYRAMID": int(mujoco.mjtConstraint.mjCNSTR_CONTACT_PYRAMIDAL),
    }
