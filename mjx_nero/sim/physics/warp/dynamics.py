"""The motion of trees of joints, as two GPU kernels: before the contacts and after the constraints' forces.

MuJoCo Warp goes through a tree level by level and quantity by quantity, in about ninety kernels per physics step, most of which
take microseconds for thousands of environments. Here a thread takes one tree of an environment from its positions to all that
does not depend on contacts (``tree.cu``), and from the constraints' forces to its next positions (``integrate.cu``). Between them
MuJoCo Warp finds the contacts, ``contact_rows`` makes their constraints and ``newton`` the forces.

The sources compile for the CPU as well, for tests.
"""

import itertools
from collections.abc import Callable, Iterable
from typing import Any

import mujoco
import numpy as np

from mjx_nero.sim.physics.warp import engine, kernels

# Fields of MuJoCo Warp's model and data that the sources read and write.
_MODEL = "body_pos body_quat body_ipos body_iquat body_mass body_inertia body_gravcomp jnt_pos jnt_axis jnt_stiffness"
_MODEL += " jnt_stiffnesspoly jnt_actfrcrange qpos0 qpos_spring geom_pos geom_quat dof_armature dof_damping dof_dampingpoly"
_MODEL += " actuator_gainprm actuator_biasprm actuator_gear actuator_forcerange actuator_ctrlrange"
_TREE = "qpos qvel ctrl mocap_pos mocap_quat subtree_com geom_xpos geom_xmat cdof cdof_dot cvel xpos xmat xquat M qfrc_smooth"
_INTEGRATE = "qpos qvel qacc qacc_warmstart M nefc nacon ncollision overflow"

_FREE = int(mujoco.mjtJoint.mjJNT_FREE)
_LINKS = (int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD))
_FORCES = (  # of mjtDisableBit
    mujoco.mjtDisableBit.mjDSBL_SPRING
    | mujoco.mjtDisableBit.mjDSBL_DAMPER
    | mujoco.mjtDisableBit.mjDSBL_GRAVITY
    | mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL
    | mujoco.mjtDisableBit.mjDSBL_ACTUATION
)


def missing(m: mujoco.MjModel) -> list[str]:
    """Lists features of a model that these kernels do not support, so that MuJoCo Warp's own must step it."""
    linked = np.isin(m.eq_type, _LINKS)
    free = m.jnt_type == mujoco.mjtJoint.mjJNT_FREE
    driven = m.jnt_type[m.actuator_trnid[:, 0]]
    found = {
        "tendons": m.ntendon,
        "flexes": m.nflex,
        "activations": m.na,
        "delayed drives": m.nhistory,
        "another integrator": m.opt.integrator != mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
        "a fluid": m.opt.density or m.opt.viscosity,
        "disabled forces": m.opt.disableflags & int(_FORCES),
        "sleep": m.opt.enableflags & mujoco.mjtEnableBit.mjENBL_SLEEP,
        "ball joints": (m.jnt_type == mujoco.mjtJoint.mjJNT_BALL).any(),
        "springs of free bodies": m.jnt_stiffness[free].any() or m.jnt_stiffnesspoly[free].any(),
        "drives that carry weight": m.jnt_actgravcomp.any(),
        "drives of no joint": (m.actuator_trntype != mujoco.mjtTrn.mjTRN_JOINT).any() or (driven == _FREE).any(),
        "drives with dynamics": (m.actuator_dyntype != mujoco.mjtDyn.mjDYN_NONE).any(),
        "gains that vary": (m.actuator_gaintype != mujoco.mjtGain.mjGAIN_FIXED).any(),
        "biases that are not affine": (m.actuator_biastype > int(mujoco.mjtBias.mjBIAS_AFFINE)).any(),
        "links between sites": (m.eq_objtype[linked] != mujoco.mjtObj.mjOBJ_BODY).any(),
    }
    return [what for what, has in found.items() if has]


def make(m: mujoco.MjModel, model, data) -> tuple[Callable[[], None], Callable[[], None]]:
    """Makes the parts of a step before the contacts and after the constraint forces.

    Args:
        m: a model without ``missing`` features.
        model, data: MuJoCo Warp's model and data of ``m``. The integrator reads ``data.efc.Ma`` and ``data.qacc``.

    Returns:
        Two functions without arguments.
    """
    import warp as wp

    constants = _constants(m)
    made = {"timestep": model.opt.timestep, "implicit": wp.zeros((data.nworld, m.nv), dtype=float)}
    made["spin"] = wp.zeros((data.nworld, max(1, 18 * len(_free(m)))), dtype=float)
    before = made | {"gravity": model.opt.gravity} | _named(model, _MODEL) | _named(data, _TREE)
    after = made | {"efc_Ma": data.efc.Ma, "efc_J_rownnz": data.efc.J_rownnz, "efc_J_rowadr": data.efc.J_rowadr}
    after |= _named(data, _INTEGRATE) | {name: int(getattr(data, name)) for name in ("njmax", "njmax_nnz", "naconmax")}
    constants |= {"SPARSE": int(model.is_sparse)}
    n = data.nworld * (len(_parts(m)) - 1)
    return kernels.make(["tree"], constants, before, n), kernels.make(["integrate"], constants, after, n)


def _constants(m: mujoco.MjModel) -> dict[str, int | Iterable[int]]:
    """The sizes and the tables that the sources are compiled with."""
    bodies = np.arange(m.nbody + 1)
    stands = (m.body_weldid[m.geom_bodyid] == 0) & (m.body_mocapid[m.body_rootid[m.geom_bodyid]] < 0)
    free, parts = _free(m), np.array(_parts(m))
    before = parts[np.searchsorted(parts, bodies[:-1], side="right") - 1] - 1  # of each body's part: stands for the world there
    first_dof, rows = np.searchsorted(m.dof_bodyid, bodies), np.array([*m.M_rowadr, m.nC])
    assert (m.M_rowadr + m.M_rownnz)[:-1].tolist() == m.M_rowadr[1:].tolist()
    found: dict[str, int | Iterable[int]] = {
        "PART": parts,
        "PARENT": np.where(m.body_parentid > 0, m.body_parentid, before),
        "ROOT": m.body_rootid,
        "MOCAP": m.body_mocapid,
        "FIRST_JOINT": np.searchsorted(m.jnt_bodyid, bodies),
        "FIRST_DOF": first_dof,
        "TYPE": m.jnt_type,
        "QPOS": m.jnt_qposadr,
        "DOF": m.jnt_dofadr,
        "ROW": rows,
        "COLUMN": m.M_colind,
        "FIRST_GEOM": np.searchsorted(m.geom_bodyid, bodies),
        "STANDS": stands,
        "FREE_BODY": free,
        "FLIES": [any(begin <= b < end for b in free) for begin, end in itertools.pairwise(parts)],
        "FREE_AT": [free.index(b) if b in free else -1 for b in range(m.nbody)],
        "JOINT_OF_DRIVE": m.actuator_trnid[:, 0],
        "AFFINE": m.actuator_biastype == mujoco.mjtBias.mjBIAS_AFFINE,
        "CTRL_LIMITED": m.actuator_ctrllimited,
        "FORCE_LIMITED": m.actuator_forcelimited,
        "JOINT_LIMITED": m.jnt_actfrclimited,
    }
    found |= {"NB": m.nbody, "NQ": m.nq, "NV": m.nv, "NG": m.ngeom, "NU": m.nu, "NFREE": len(free)}
    of_a_part = {"BODIES": 1 + np.diff(parts), "DOFS": np.diff(first_dof[parts]), "ENTRIES": np.diff(rows[first_dof[parts]])}
    found |= {name: max(1, *map(int, sizes)) for name, sizes in of_a_part.items()}
    found |= {
        "FREE": _FREE,
        "SLIDE": int(mujoco.mjtJoint.mjJNT_SLIDE),
        "LINKS": int(np.isin(m.eq_type, _LINKS).any()),
        "GRAVCOMP": int(m.ngravcomp > 0),
    }
    found |= {name: int(engine.OverflowType[name]) for name in ("NEFC", "NJMAX_NNZ", "BROADPHASE", "NARROWPHASE")}
    return found


def _parts(m: mujoco.MjModel) -> list[int]:
    """Splits the bodies into parts that no joint couples: returns their first bodies, and one past the last of all."""
    ends = [*(b for b in range(1, m.nbody) if m.body_parentid[b] == 0), m.nbody]
    moving = [begin for begin, end in itertools.pairwise(ends) if m.body_dofnum[begin:end].any()]
    return [1, *moving[1:], m.nbody]


def _free(m: mujoco.MjModel) -> list[int]:
    """Bodies that fly freely and carry nothing that moves."""
    free = [int(m.jnt_bodyid[j]) for j in range(m.njnt) if m.jnt_type[j] == _FREE]
    return [b for b in free if m.tree_dofnum[m.body_treeid[b]] == 6]


def _named(of: Any, names: str) -> dict[str, Any]:
    return {name: getattr(of, name) for name in names.split()}
