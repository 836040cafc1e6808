"""The contacts' rows of the constraints against MuJoCo Warp's own. Without a GPU Warp runs the same source on the CPU."""

import mujoco
import numpy as np
import pytest

from mjx_nero.sim.physics.warp import contact_rows

wp = pytest.importorskip("warp")

# An arm over a table, with a limit, friction in a joint, and two boxes; all forms of solver parameters.
SCENE = """
<mujoco>
  <option cone="{cone}" jacobian="{jacobian}" impratio="10"><flag refsafe="{refsafe}"/></option>
  <default><geom condim="{dims}"/></default>
  <worldbody>
    <geom type="plane" size="2 2 1"/>
    <body pos="0 0 0.3">
      <joint axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03"/>
      <body pos="0.3 0 0">
        <joint axis="0 1 0" frictionloss="0.1" range="-1 0.2" limited="true"/>
        <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03" solref="0.03 0.7" solimp="0.5 0.9 0.01 0.3 3"
          friction="0.6 0.02 0.003"/>
        <body pos="0.1 0 -0.1"><joint type="slide" axis="1 0 0"/><geom size="0.05" solref="0.002 1"/></body>
      </body>
    </body>
    <body pos="0.2 0 0.08"><freejoint/><geom name="low" type="box" size="0.05 0.05 0.05" solref="-500 -20"/></body>
    <body pos="0.25 0.02 0.2"><freejoint/><geom name="high" type="box" size="0.05 0.05 0.05"/></body>
  </worldbody>
  <contact><pair geom1="high" geom2="low" condim="{dims}" solreffriction="0.05 1" solimp="0.9 0.9 0.001 0.5 2"/></contact>
</mujoco>
"""
WORLDS = 6


def scene(cone="elliptic", jacobian="dense", dims=4, refsafe="enable"):
    return mujoco.MjModel.from_xml_string(SCENE.format(cone=cone, jacobian=jacobian, dims=dims, refsafe=refsafe))


def moving(model):
    """Positions and velocities [worlds, ...] while things fall, slide and press."""
    rng, data, found = np.random.default_rng(0), mujoco.MjData(model), []
    for _ in range(WORLDS):
        mujoco.mj_resetData(model, data)
        data.qpos[:] += 0.05 * rng.normal(size=model.nq)
        data.qvel[:] = rng.normal(size=model.nv)
        mujoco.mj_step(model, data, nstep=40)
        found.append((data.qpos.copy(), data.qvel.copy()))
    return [np.array(x, np.float32) for x in zip(*found, strict=True)]


def rows(model, state, own, njmax=120, **sizes):
    """MuJoCo Warp's data with the rows of constraints, by our kernel or by its own, and its model."""
    from mujoco.mjx.third_party import mujoco_warp

    warp_model = mujoco_warp.put_model(model)
    data = mujoco_warp.make_data(model, WORLDS, naconmax=40 * WORLDS, njmax=njmax, **sizes)
    warp_model.body_invweight0 = wp.array(  # another one in each world
        np.stack([(1 + i) * model.body_invweight0 for i in range(WORLDS)]).astype(np.float32), dtype=wp.vec2
    )
    for array, values in zip((data.qpos, data.qvel), state, strict=True):
        wp.copy(array, wp.array(values))
    mujoco_warp.fwd_position(warp_model, data)
    mujoco_warp.fwd_velocity(warp_model, data)
    mujoco_warp.collision(warp_model, data)
    make = contact_rows.make(model, warp_model, data) if own else lambda: mujoco_warp.make_constraint(warp_model, data)
    make()
    make()  # counters begin anew
    return data, warp_model


def jacobian(data, model, world, n):
    if not model.is_sparse:
        return data.efc.J.numpy()[world, :n, : model.nv]
    found = np.zeros((n, model.nv))
    starts, counts, columns, J = (getattr(data.efc, name).numpy()[world] for name in ("J_rowadr", "J_rownnz", "J_colind", "J"))
    for row in range(n):
        at = slice(starts[row], starts[row] + counts[row])
        found[row, columns[0, at]] = J[0, at]
    return found


@pytest.mark.parametrize("refsafe", ["enable", "disable"])
@pytest.mark.parametrize("dims", [1, 3, 4, 6])
@pytest.mark.parametrize("form", ["dense", "sparse"])
@pytest.mark.parametrize("cone", ["elliptic", "pyramidal"])
def test_rows_are_mujocos(cone, form, dims, refsafe):
    model = scene(cone, form, dims, refsafe)
    state = moving(model)
    (theirs, _), (ours, warp_model) = (rows(model, state, own) for own in (False, True))
    assert (ours.nefc.numpy() == theirs.nefc.numpy()).all() and ours.nefc.numpy().max() > 3 * dims
    for name in ("efc_address", "dim"):
        assert (getattr(ours.contact, name).numpy() == getattr(theirs.contact, name).numpy()).all()
    assert not ours.overflow.numpy().any()
    for world, n in enumerate(ours.nefc.numpy()):
        np.testing.assert_allclose(
            jacobian(ours, warp_model, world, n), jacobian(theirs, warp_model, world, n), rtol=1e-5, atol=1e-6
        )
        for name in ("D", "aref", "frictionloss", "type", "id"):
            mine, other = (getattr(data.efc, name).numpy()[world, :n] for data in (ours, theirs))
            np.testing.assert_allclose(mine, other, rtol=1e-4, atol=1e-5 * np.abs(other).max())


def test_rows_beyond_the_buffer_are_counted_and_not_written():
    model = scene()
    state = moving(model)
    whole, _ = rows(model, state, own=True)
    needed = whole.nefc.numpy()
    most = int(needed.max()) - 2  # cuts the last contact of the fullest world
    cut, _ = rows(model, state, own=True, njmax=most)
    assert (cut.nefc.numpy() == needed).all()
    world = int(needed.argmax())
    addresses = cut.contact.efc_address.numpy()[cut.contact.worldid.numpy() == world]
    assert addresses.max() == most - 1 and (addresses == -1).any()
    for name in ("D", "aref", "id"):
        kept, all_of_them = (getattr(data.efc, name).numpy()[world, :most] for data in (cut, whole))
        np.testing.assert_array_equal(kept, all_of_them)


def test_nonzeros_beyond_the_buffer_are_reported():
    from mujoco.mjx.third_party.mujoco_warp._src.types import OverflowType

    model = scene(jacobian="sparse")
    state = moving(model)
    whole, warp_model = rows(model, state, own=True)
    n = whole.nefc.numpy()
    nonzeros = [whole.efc.J_rownnz.numpy()[world, : n[world]].sum() for world in range(WORLDS)]
    room = int(max(nonzeros)) - 1
    cut, _ = rows(model, state, own=True, njmax_nnz=room)
    for world in range(WORLDS):
        lost = nonzeros[world] > room
        assert bool(cut.overflow.numpy()[world] & OverflowType.NJMAX_NNZ) == lost
        ends = cut.efc.J_rowadr.numpy()[world, : n[world]] + cut.efc.J_rownnz.numpy()[world, : n[world]]
        assert ends.max() <= room
        missing = (cut.efc.J_rownnz.numpy()[world, : n[world]] == 0).sum()
        assert (missing > 0) == lost


def test_without_contacts_only_the_other_rows_are_left():
    model = scene()
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    data, warp_model = rows(model, moving(model), own=True)
    n, contact = data.nefc.numpy(), int(mujoco.mjtConstraint.mjCNSTR_CONTACT_FRICTIONLESS)
    assert (n > 0).any()
    assert all((data.efc.type.numpy()[world, : n[world]] < contact).all() for world in range(WORLDS))
    assert warp_model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONTACT
