"""Couplings of joints: where MuJoCo's equalities want the followers."""

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjx_nero.sim import linkage

# The polynomial counts from the joints' reference positions; equalities with one joint; chains out of order; inactive ones.
MODEL = """
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <body><joint name="a" ref="0.3"/><geom size="0.1"/></body>
    <body><joint name="b" ref="-0.2"/><geom size="0.1"/></body>
    <body><joint name="c" type="slide"/><geom size="0.1"/></body>
    <body><joint name="d" ref="0.1"/><geom size="0.1"/></body>
    <body><joint name="e"/><geom size="0.1"/></body>
  </worldbody>
  <equality>
    <joint joint1="c" joint2="b" polycoef="0.01 0.5 0.2 0 0"/>
    <joint joint1="b" joint2="a" polycoef="0.1 -2 0 0 0"/>
    <joint joint1="d" polycoef="0.4 0 0 0 0"/>
    <joint joint1="e" joint2="a" polycoef="0 1 0 0 0" active="false"/>
  </equality>
</mujoco>
"""


@pytest.mark.parametrize("a", [0.3, 0.8, -1.0])
def test_followers_are_where_every_active_equality_holds(a):
    model = mujoco.MjModel.from_xml_string(MODEL)
    qpos = jnp.zeros(5).at[0].set(a).at[4].set(0.7)
    for coupling in linkage.couplings(model):
        qpos = qpos.at[coupling.follower].set(coupling.position(qpos))
    b = -0.2 + 0.1 - 2 * (a - 0.3)
    c = 0.01 + 0.5 * (b + 0.2) + 0.2 * (b + 0.2) ** 2
    np.testing.assert_allclose(qpos, [a, b, c, 0.5, 0.7], atol=1e-6)
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    assert data.ne == 3 and np.abs(data.efc_pos[:3]).max() < 1e-6


def test_a_model_without_equalities_has_no_couplings():
    assert linkage.couplings(mujoco.MjModel.from_xml_string("<mujoco/>")) == []
