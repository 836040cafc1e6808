"""Rotations by MuJoCo, in double precision: quaternions are wxyz."""

from typing import Any

import mujoco
import numpy as np


def product(a: Any, b: Any) -> np.ndarray:
    """The rotation ``b`` first, then ``a``."""
    out = np.zeros(4)
    mujoco.mju_mulQuat(out, np.asarray(a, float), np.asarray(b, float))
    return out


def about(axis: Any, angle: float) -> np.ndarray:
    """A turn by ``angle`` [rad] about the unit vector ``axis``."""
    out = np.zeros(4)
    mujoco.mju_axisAngle2Quat(out, np.asarray(axis, float), angle)
    return out


def rotated(vec: Any, quat: Any) -> np.ndarray:
    """``vec`` turned by ``quat``."""
    out = np.zeros(3)
    mujoco.mju_rotVecQuat(out, np.asarray(vec, float), np.asarray(quat, float))
    return out


def matrix(quat: Any) -> np.ndarray:
    """The matrix [3, 3] of a quaternion, of unit length or not: its columns are the turned axes."""
    out = np.zeros(9)
    mujoco.mju_quat2Mat(out, np.asarray(quat, float) / np.linalg.norm(quat))
    return out.reshape(3, 3)


def of_matrix(turn: Any) -> np.ndarray:
    """The quaternion of a matrix [3, 3]."""
    out = np.zeros(4)
    mujoco.mju_mat2Quat(out, np.array(turn, float).ravel())
    return out
