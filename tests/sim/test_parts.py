"""The kinds of things in a scene as one: what each adds, in order, and what a kind that adds nothing leaves alone."""

from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np

from mjx_nero.sim import scene
from mjx_nero.sim.parts import Part, Parts
from mjx_nero.tasks import registry
from mjx_nero.types import Start


class Clock(Part):
    """A hand that starts at noon: it differs by a field, has the first joint, and is drawn red."""

    fields, seen = ("dof_damping", "geom_pos"), ("geom_rgba",)

    def blank(self):
        return {"shape": {"clock": 12}}

    def given(self, start):
        return {"dof_damping": jnp.full(2, float(start.shape["clock"]))}

    def qpos(self, qpos, start, fields):
        return qpos.at[0].set(fields["dof_damping"][0])

    def memory(self, start):
        return {"hour": start.shape["clock"]}

    def late(self, key, see, fields):
        return {**fields, "geom_pos": see()}

    def scenery(self, sim, carry, look):
        return {"look": {**look, "geom_rgba": "red"}}


class Bell(Part):
    """It rings by the clock's field, and is painted over what the clock painted."""

    fields = ("geom_pos", "body_mass")

    def late(self, key, see, fields):
        return {**fields, "geom_pos": fields["geom_pos"] + 1}

    def view(self, sim, carry):
        return {"readings": {"bell": carry}}

    def scenery(self, sim, carry, look):
        return {"look": {name: f"dark {value}" for name, value in look.items()}, "objects": {}}


START = Start(jnp.zeros(1), {}, {}, shape={"clock": 12})


def test_each_adds_its_own_and_sees_what_came_before():
    parts = Parts(Clock(), Part(), Bell())
    assert parts.fields == ("dof_damping", "geom_pos", "body_mass") and parts.seen == ("geom_rgba",)
    assert parts.blank() == {"shape": {"clock": 12}} and parts.memory(START) == {"hour": 12}
    given = parts.given(START)
    np.testing.assert_array_equal(parts.qpos(jnp.zeros(2), START, given), [12.0, 0.0])
    assert parts.late(None, lambda: 4, {"x": 0}) == {"x": 0, "geom_pos": 5}
    assert parts.view(None, 7) == {"readings": {"bell": 7}} and parts.start(None, None) == {}
    assert parts.scenery(None, None, {"mat_rgba": "blue"}) == {
        "look": {"mat_rgba": "dark blue", "geom_rgba": "dark red"},
        "objects": {},
    }


def test_a_kind_of_which_there_is_none_adds_nothing():
    parts = Parts(Part())
    assert parts.fields == parts.seen == () and parts.blank() == parts.given(START) == parts.memory(START) == {}
    assert parts.late(None, None, {"x": 0}) == {"x": 0} and parts.scenery(None, None, {}) == {"look": {}}


def test_a_start_that_is_taken_from_a_view_begins_there():
    """Objects where they are seen; the fixture and the shape that the episode has."""
    cfg = registry.env_cfg("nero_open_drawer")
    model = scene.build(cfg.robot, cfg.scene, cfg.sim, visuals=False)
    parts = scene.parts(cfg.scene, model)
    blank = parts.blank()
    sim = SimpleNamespace(qpos=jnp.asarray(model.qpos0, jnp.float32), qvel=jnp.zeros(model.nv), fields={})
    carry = SimpleNamespace(memory={})
    seen = SimpleNamespace(**parts.view(sim, carry))
    again = parts.start(seen, carry)
    assert set(again) == {"object_pos_w", "object_quat_w", "target", "shape", "fixtures"}
    (name,) = blank["fixtures"]
    np.testing.assert_allclose(again["fixtures"][name].pos_w, blank["fixtures"][name].pos_w, atol=1e-6)
    assert set(again["fixtures"][name].joint_pos) == set(blank["fixtures"][name].joint_pos)
