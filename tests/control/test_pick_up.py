"""The controller that picks up: how it turns the hand, where it grasps, when it goes on. The task tests what comes of it."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import views

from mjx_nero import UserError, control
from mjx_nero.control import gripper, pick_up
from mjx_nero.control.pick_up import PickUp, PickUpCfg
from mjx_nero.sim import grasp
from mjx_nero.tasks.arms.cobotta_pro_900 import COBOTTA_PRO_900
from mjx_nero.tasks.arms.nero import NERO
from mjx_nero.tasks.arms.so_arm100 import LIFT, SO_ARM100
from mjx_nero.types import ObjectView, View

CFG = PickUpCfg(object="target", heading=(0, 2, 0), turns=(4, 2, 0), lowest=0.03)


@pytest.fixture(scope="module")
def controller():
    return PickUp(COBOTTA_PRO_900, 0.02, CFG)


def seen(index: int, quat=(1.0, 0.0, 0.0, 0.0), others=(), height=0.05) -> View:
    """The commanded object at (0.5, 0.1), others beside it along x and y [m]."""
    still = {"linvel_w": jnp.zeros(3), "angvel_local": jnp.zeros(3)}
    target = ObjectView(pos_w=jnp.array([0.5, 0.1, height]), quat_w=jnp.array(quat), **still)
    away = {f"other{i}": dataclasses.replace(target, pos_w=target.pos_w + jnp.array([*xy, 0.0])) for i, xy in enumerate(others)}
    joints = dict.fromkeys(("joint_pos", "default_joint_pos", "ctrl"), jnp.array(COBOTTA_PRO_900.home))
    return views.blank(
        **joints,
        joint_vel=jnp.zeros(8),
        ee_pos_w=jnp.array([0.5, 0.0, 0.28]),
        ee_quat_w=jnp.array(COBOTTA_PRO_900.down),
        objects={"itself": target, **away, "target": target},
        goal_pos_w=jnp.array([0.5, 0.0, 0.3]),
        target=jnp.array(index),
    )


def turned(degrees: float) -> tuple[float, ...]:
    return math.cos(math.radians(degrees) / 2), 0.0, 0.0, math.sin(math.radians(degrees) / 2)


def test_the_ways_to_turn_the_hand_by_hand(controller):
    """A box turned by 20 degrees: every quarter fits; a lying capsule that points there: every half; a ball: every eighth."""
    half = 0.5**0.5
    w, _, _, z = turned(20)
    lying = (w * half, -z * half, w * half, z * half)  # its z axis along x, then turned
    for index, quat, wanted in (
        (0, turned(20), np.tile([20, 110, 200, 290], 2)),
        (1, lying, np.tile([20, 200], 4)),
        (2, turned(77), 45 * np.arange(8)),
    ):
        angles = np.degrees(controller._angles(seen(index, quat)))
        np.testing.assert_allclose(np.mod(angles - wanted + 1, 360), 1, atol=1e-3)


def test_room_beside_others_by_hand(controller):
    """Fingers at 75.5 mm to both sides, along y: 5.5 mm from another at 70 mm; turned by a quarter, as far as counts."""
    room = controller._room(seen(0, others=[(0.0, 0.07)]), jnp.array([0.0, math.pi / 2, math.pi]))
    np.testing.assert_allclose(room, [0.0055, 0.0755, 0.0055], atol=1e-5)


def test_it_grasps_at_the_objects_middle_or_as_low_as_the_pads_allow(controller):
    np.testing.assert_allclose(controller._pick(seen(0), jnp.array(0.3)), [0.5, 0.1, 0.05], atol=1e-6)
    np.testing.assert_allclose(controller._pick(seen(0, height=0.01), jnp.array(0.3)), [0.5, 0.1, 0.03], atol=1e-6)
    # An object whose middle is at 6 mm would be at the pads' lower edge, at 5 mm: they go down to 3 mm.
    np.testing.assert_allclose(controller._pick(seen(0, height=0.006), jnp.array(0.3)), [0.5, 0.1, 0.028], atol=1e-6)
    longer = PickUp(COBOTTA_PRO_900, 0.02, dataclasses.replace(CFG, beyond=0.004))
    np.testing.assert_allclose(longer._pick(seen(0, height=0.01), jnp.array(0.3)), [0.5, 0.1, 0.034], atol=1e-6)


def test_how_far_beyond_the_grasp_point_the_pads_are_by_hand():
    """Nero's begin 135.8 mm from its flange, 10 mm long; the grasp point is at 125. The Cobotta's reach back over theirs."""
    assert grasp.beyond(NERO, 0.04) == pytest.approx(0.1358 - 0.005 - 0.125)
    assert grasp.beyond(COBOTTA_PRO_900, 0.06) == 0


def test_pads_are_where_they_are_though_the_grasp_points_frame_is_farther_back():
    """An imported hand's frame may lie centimetres behind its pads: ``grip`` says so, and nothing is beyond that."""
    half, back = (dataclasses.replace(NERO, grip=(0.0, 0.0, way)) for way in (0.0038, 0.0058))
    assert grasp.beyond(half, 0.04) == pytest.approx(0.002) and grasp.beyond(back, 0.04) == 0
    at = PickUp(back, 0.02, dataclasses.replace(CFG, beyond=grasp.beyond(back, 0.04)))._pick(seen(0), jnp.array(0.3))
    np.testing.assert_allclose(at, [0.5, 0.1, 0.05 + 0.0058], atol=1e-6)


def test_a_jaw_that_turns_goes_beside_a_small_object_as_it_goes_beside_the_cube():
    """The fixed face stays where it is, so the pads' middle moves by half of what the gap does, and a little as the jaw turns."""
    cube = grasp.cube_for(SO_ARM100).size[0] + 2 * grasp.BESIDE
    for gap in (0.02, 0.03):
        assert grasp.aside(SO_ARM100, gap) == pytest.approx((cube - gap) / 2, abs=0.002)
    assert grasp.aside(SO_ARM100, cube) == grasp.aside(NERO, 0.02) == grasp.aside(COBOTTA_PRO_900, 0.03) == 0
    aside = PickUp(COBOTTA_PRO_900, 0.02, dataclasses.replace(CFG, aside=(0.0, 0.0, 0.006)))
    for index, wanted in ((0, [0.5, 0.1, 0.05]), (2, [0.5 + 0.006, 0.1, 0.05])):  # turned by a quarter, the fingers open along -x
        np.testing.assert_allclose(aside._pick(seen(index), jnp.array(math.pi / 2)), wanted, atol=1e-6)


def test_the_hand_comes_down_with_the_cube_amid_its_open_fingers():
    """The SO-ARM's fixed jaw would come down 4 mm beside a cube of 30 mm; amid the open jaws it is 5 mm further off."""
    fields = LIFT.controllers(SO_ARM100)["pick_up"]
    assert fields["aside"] == (pytest.approx(-0.005, abs=1e-3),) and fields["above"] == pytest.approx(0.03 + 0.02)
    made = control.make("pick_up", SO_ARM100, 0.02, fields)
    np.testing.assert_allclose(np.abs(made._point), np.abs(grasp.opening(SO_ARM100)) * 0.005, atol=1e-3)


def test_fingers_whose_drives_lag_get_time_to_press():
    """A third of a second, the jaw's damping over its stiffness: its targets take as much longer, and the hand waits as long."""
    slow, quick = (PickUp(robot, 0.02, PickUpCfg(closing=0.4)) for robot in (SO_ARM100, NERO))
    assert slow.closed == pytest.approx(0.4 + 2 / 3 + gripper.PRESS) and quick.closed == pytest.approx(0.4 + 0.05 + gripper.PRESS)
    np.testing.assert_allclose(slow.finger_step, 0.5 * 0.02 / (0.4 + 1 / 3), rtol=1e-5)
    assert slow.gentle == 6.0 and quick.gentle == 1.5  # [rad/s2]: the SO-ARM's own drives hardly lag, Nero's by half a second


def fresh() -> pick_up.PickUpMemory:
    zero, q = jnp.zeros((), jnp.int32), jnp.zeros(6)
    return pick_up.PickUpMemory(zero, zero, q, q, zero, q, jnp.zeros(3), jnp.zeros(3), jnp.zeros(()), jnp.zeros(3))


def test_a_hand_that_has_lost_an_object_follows_it_as_it_falls(controller):
    """Where it was lost, in the air, there would be nothing to grasp."""
    step = jax.jit(controller.step)
    for tries, follows in ((0, False), (1, True)):
        memory = dataclasses.replace(fresh(), tries=jnp.array(tries))
        for height in (0.3, 0.2):
            memory, _ = step(memory, seen(0, height=height))
            np.testing.assert_allclose(memory.pick, [0.5, 0.1, height] if follows else np.zeros(3), atol=1e-6)


def test_phases_end_when_their_work_is_done_or_their_time_is_over(controller):
    memory = fresh()

    def ends(phase, count=0, error=0.0, arrived=True, qd=0.0, gripped=False) -> bool:
        now = dataclasses.replace(memory, phase=jnp.array(phase), count=jnp.array(count), qd=jnp.full(6, qd))
        return bool(controller._ended(now, jnp.array(error), jnp.array(arrived), jnp.array(gripped)))

    assert ends(pick_up.ABOVE, error=0.009, arrived=False) and not ends(pick_up.ABOVE, error=0.011, arrived=False)
    assert ends(pick_up.ABOVE, error=0.011) and not ends(pick_up.ABOVE, error=0.011, qd=0.2)  # it reaches no further
    assert ends(pick_up.ABOVE, error=1.0, arrived=False, count=125)
    assert ends(pick_up.DOWN, error=0.003) and not ends(pick_up.DOWN, error=0.005) and not ends(pick_up.DOWN, arrived=False)
    # An arm that has arrived beside the object gets no nearer; one that is still on its way may.
    assert ends(pick_up.DOWN, error=0.005, count=40) and not ends(pick_up.DOWN, error=0.005, arrived=False, count=40)
    assert ends(pick_up.DOWN, arrived=False, count=75)
    assert not ends(pick_up.CLOSE, count=26) and ends(pick_up.CLOSE, count=27)  # 0.3 s of closing, 0.1 s of lag and 0.15 s
    assert not ends(pick_up.CLOSE, count=24, gripped=True) and ends(pick_up.CLOSE, count=25, gripped=True)  # half of the lag
    assert ends(pick_up.UP) and not ends(pick_up.UP, arrived=False) and not ends(pick_up.CARRY, count=10_000)


@pytest.mark.parametrize("fields", [{"turns": (4, 2)}, {"heading": (0, 3), "turns": (1, 1)}, {"turns": (-1,)}])
def test_what_does_not_say_how_objects_lie_is_refused(fields):
    with pytest.raises(UserError, match="heading and turns take an axis .0 to 2. and a number per object, got"):
        control.make("pick_up", COBOTTA_PRO_900, 0.02, fields)
    with pytest.raises(UserError, match="aside takes one value per object, got .0.01, 0.02. for 1"):
        control.make("pick_up", COBOTTA_PRO_900, 0.02, {"aside": (0.01, 0.02)})
