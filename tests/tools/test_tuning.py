"""Gains from the model: step responses against the analytic second-order system, loads and proposals by hand, and the files."""

import dataclasses
import functools
import math

import imageio.v3 as imageio
import mujoco
import numpy as np
import pytest
import yaml
from rich.console import Console

from mjx_nero.sim.robot import GripperCfg
from mjx_nero.sim.scene import SimCfg
from mjx_nero.tasks import registry
from mjx_nero.tools import tuning
from mjx_nero.tools.tuning import Load, propose
from mjx_nero.types import UserError

WN, INERTIA = 10.0, 0.5
STIFFNESS = WN**2 * INERTIA


def joint_model(ratio=1.0, effort=1e3, gravity=0.0, dt=2e-4, axis="0 0 1", kind="hinge"):
    """One joint of INERTIA with a drive of STIFFNESS and damping ratio ``ratio``."""
    return mujoco.MjModel.from_xml_string(f"""
      <mujoco><compiler angle="radian"/>
      <option timestep="{dt}" integrator="implicitfast" gravity="0 0 {gravity}"/><worldbody><body name="b">
        <joint name="j" type="{kind}" axis="{axis}" range="-3 3" limited="true"/>
        <inertial pos="0 0 0" mass="{INERTIA}" diaginertia="{INERTIA} {INERTIA} {INERTIA}"/></body></worldbody>
      <actuator><position name="j" joint="j" kp="{STIFFNESS}" kv="{2 * ratio * math.sqrt(STIFFNESS * INERTIA)}"
        forcerange="-{effort} {effort}"/></actuator></mujoco>""")


def test_critically_damped_response():
    (response,) = tuning.respond(joint_model(), [0.0], 0.1, seconds=2)
    assert response.step == pytest.approx(0.1) and response.joint == "j"
    assert response.rise == pytest.approx(3.358 / WN, rel=5e-3)
    assert response.overshoot == pytest.approx(0, abs=1e-6)
    assert response.settling == pytest.approx(5.834 / WN, rel=5e-3)  # (1 + x) exp(-x) = 0.02
    assert response.error == pytest.approx(0, abs=1e-6) and response.saturation == 0
    assert response.force[0] == pytest.approx(STIFFNESS * 0.1)


def test_underdamped_response():
    (response,) = tuning.respond(joint_model(ratio=0.5), [0.0], 0.1, seconds=3)
    assert response.overshoot == pytest.approx(math.exp(-math.pi * 0.5 / math.sqrt(0.75)), rel=0.01)
    assert response.rise == pytest.approx(1.64 / WN, rel=0.01)  # the text-book curve at ratio 0.5


def test_overdamped_response():
    (response,) = tuning.respond(joint_model(ratio=5.0), [0.0], 0.1, seconds=6)
    pole = WN * (5 - math.sqrt(24))  # the slow one of two
    assert response.rise == pytest.approx(math.log(9) / pole, rel=0.01) and response.overshoot <= 0


def test_sag_is_an_error_that_stays():
    (response,) = tuning.respond(joint_model(gravity=-9.81, kind="slide"), [0.0], 0.1, seconds=3)
    assert response.error == pytest.approx(INERTIA * 9.81 / STIFFNESS, rel=1e-3)
    assert response.position[-1] == pytest.approx(0.1, abs=1e-5)  # the way itself is the step's


def test_saturation_slows_and_is_told():
    (response,) = tuning.respond(joint_model(effort=0.5 * STIFFNESS * 0.1), [0.0], 0.1, seconds=3)
    free = tuning.respond(joint_model(), [0.0], 0.1, seconds=3)[0]
    assert response.rise > free.rise and 0.05 < response.saturation < 0.5
    assert np.abs(response.force).max() <= 0.5 * STIFFNESS * 0.1 + 1e-9


def test_what_still_moves_has_not_settled():
    (response,) = tuning.respond(joint_model(ratio=50.0), [0.0], 0.1, seconds=0.5)
    assert response.settling == math.inf


@pytest.mark.parametrize(("pose", "step"), [(0.0, 0.1), (2.95, -0.1), (-2.95, 0.1)])
def test_steps_go_away_from_the_nearer_limit(pose, step):
    assert tuning.steps(joint_model(), [pose], 0.1) == pytest.approx(step)
    assert tuning.steps(joint_model(), [pose], 10.0) == pytest.approx(6 * step)  # a tenth of the range


# --- what a drive has to move


def polar(gravity, armature=0.2, mass=2.0):
    """A point mass on a slide, 1 to 2 m from a hinge about y."""
    return mujoco.MjModel.from_xml_string(f"""
      <mujoco><option gravity="0 0 {gravity}"/><worldbody><body>
        <joint name="turn" axis="0 1 0" range="-180 180" armature="{armature}" damping="0.3"/>
        <inertial pos="0 0 0" mass="1e-9" diaginertia="1e-9 1e-9 1e-9"/>
        <body><joint name="out" type="slide" axis="1 0 0" range="1 2"/>
          <inertial pos="0 0 0" mass="{mass}" diaginertia="1e-9 1e-9 1e-9"/></body></body></worldbody>
      <actuator><position name="turn" joint="turn" kp="1" forcerange="-60 60"/>
        <position name="out" joint="out" kp="1"/></actuator>
      </mujoco>""")


def test_loads_of_a_polar_arm():
    turn, out = tuning.loads(polar(-9.81))
    assert turn.light == pytest.approx(0.2 + 2 * 1.05**2, rel=0.03) and turn.heavy == pytest.approx(0.2 + 2 * 1.95**2, rel=0.02)
    assert 0.9 * 2 * 9.81 * 2 < turn.gravity < 2 * 9.81 * 2
    assert (turn.joint, turn.effort, turn.friction) == ("turn", 60, 0.3)
    assert (out.light, out.heavy) == pytest.approx((2, 2)) and out.effort == math.inf
    assert 0.98 * 2 * 9.81 < out.gravity <= 2 * 9.81
    assert tuning.loads(polar(0.0))[0].gravity == 0


def linkage(drives, ratio):
    """Slides of 1 and 3 kg, the second one coupled to the first."""
    rows = "".join(f'<position name="{name}" joint="{name}" kp="100" kv="20"/>' for name in drives)
    return mujoco.MjModel.from_xml_string(f"""
      <mujoco><option gravity="0 0 0" timestep="0.002"/><worldbody>
        <body><joint name="a" type="slide" axis="1 0 0" range="-1 1"/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body>
        <body><joint name="b" type="slide" axis="1 0 0" range="-1 1"/><inertial pos="0 0 0" mass="3" diaginertia="1 1 1"/></body>
      </worldbody><equality><joint joint1="b" joint2="a" polycoef="0 {ratio} 0 0 0"/></equality>
      <actuator>{rows}</actuator></mujoco>""")


def test_coupled_joints_count_together():
    assert [load.heavy for load in tuning.loads(linkage("ab", -1))] == pytest.approx([2, 2])  # 1 + 3, shared by two
    assert [load.heavy for load in tuning.loads(linkage("a", 2))] == pytest.approx([1 + 2**2 * 3])
    assert [load.heavy for load in tuning.loads(linkage("b", 2))] == pytest.approx([3 + 1 / 2**2])


def test_coupled_joints_step_together():
    a, b = tuning.respond(linkage("ab", -1), [0.0, 0.0], 0.1)
    assert (a.step, b.step) == pytest.approx((0.1, -0.1))
    assert (a.position[-1], b.position[-1]) == pytest.approx((0.1, -0.1), abs=1e-3)
    assert tuning.respond(linkage("b", 2), [0.0], 0.1)[0].position[-1] == pytest.approx(0.1, abs=1e-3)


# --- gains

LOAD = Load("j", light=0.1, heavy=0.5, gravity=5.0, effort=25.0, friction=0.0)


def test_stiffness_keeps_the_step_within_the_effort():
    assert propose(LOAD, step=0.1, frequency=1e3, dt=0.0)[0] == pytest.approx(198)  # 99% of (25 - 5) / 0.1
    assert propose(dataclasses.replace(LOAD, gravity=0.0), step=0.1, frequency=1e3, dt=0.0)[0] == pytest.approx(247)


def test_stiffness_keeps_to_the_frequency():
    assert propose(LOAD, step=0.1, frequency=1.0, dt=0.0)[0] == pytest.approx(12.6)  # (2 pi)^2 * 0.64 * 0.5, rounded down
    assert propose(dataclasses.replace(LOAD, effort=math.inf), step=0.1, frequency=1.0, dt=0.0)[0] == pytest.approx(12.6)


def test_damping_ratio_of_the_heaviest_pose():
    stiffness, damping = propose(LOAD, step=0.1, frequency=1e3, dt=0.0)
    assert damping / (2 * math.sqrt(stiffness * 0.5)) == pytest.approx(0.8, rel=0.01)
    assert propose(dataclasses.replace(LOAD, friction=1.0), 0.1, 1e3, 0.0)[1] == pytest.approx(damping - 1, abs=0.051)
    assert propose(dataclasses.replace(LOAD, friction=1e3), 0.1, 1e3, 0.0)[1] == 0


@pytest.mark.parametrize("dt", [0.002, 0.01, 0.02])
def test_the_integrator_is_damped_critically(dt):
    """Spring force of the old position, damping of the new velocity: two equal real poles at the critical inertia."""
    stiffness, damping = propose(LOAD, step=0.1, frequency=0.5 / (2 * math.pi * 0.02), dt=dt)
    inertia = 0.64 * 0.5
    a = dt * math.sqrt(stiffness / inertia)
    slowed = 1 + damping * dt / inertia
    step = np.array([[1 - a**2 / slowed, dt / slowed], [-(a**2) / dt / slowed, 1 / slowed]])
    poles = np.linalg.eigvals(step)
    assert np.abs(poles - 1 / (1 + a)).max() < 0.15 * a / (1 + a)  # rounding to three digits parts them a little
    without = np.linalg.eigvals(
        np.array([[1 - a**2 / (1 + 2 * a), dt / (1 + 2 * a)], [-(a**2) / dt / (1 + 2 * a), 1 / (1 + 2 * a)]])
    )
    assert np.abs(without.imag).max() > 0


def test_gravity_beyond_the_effort():
    message = "j: gravity needs up to 5 from a drive limited to 4: raise its effort, or let the robot compensate gravity"
    with pytest.raises(UserError, match=message):
        propose(dataclasses.replace(LOAD, effort=4.0), 0.1, 10.0, 0.01)


# --- robots


@pytest.fixture(scope="module", params=["nero", "cobotta_pro_900"])
def tuned(request):
    return tuning.tune(registry.robot(request.param))


def test_proposals_neither_overshoot_nor_saturate(tuned):
    assert [r.joint for r in tuned.after] == list(tuned.robot.joints) == [load.joint for load in tuned.loads]
    for response, load in zip(tuned.after, tuned.loads, strict=True):
        assert response.overshoot < 0.02 and response.saturation == 0 and response.settling < 0.5
        assert np.abs(response.force).max() < load.effort


def test_proposals_settle_no_later(tuned):
    """In the majority of the joints, to a physics step; the Cobotta's own gains were found by hand at this very pose."""
    as_fast = [b.settling <= a.settling + 0.0101 for a, b in zip(tuned.before, tuned.after, strict=True)]
    assert sum(as_fast) > len(as_fast) / 2
    if tuned.robot.name == "nero":
        assert all(as_fast)


def test_proposals_hold_over_the_workspace(tuned):
    model, rng = tuning.drives_model(tuned.tuned, SimCfg()), np.random.default_rng(0)
    lower, upper = np.array([model.joint(j).range for j in tuned.robot.joints]).T
    for _ in range(3):
        pose = rng.uniform(lower, upper)
        pose[len(tuned.robot.arm.joints) :] = tuned.robot.gripper.home
        for response in tuning.respond(model, pose, 0.1, seconds=2):
            assert response.overshoot < 0.02 and response.saturation == 0


def test_gravity_compensation_ends_the_sag():
    robot = registry.robot("nero")
    sagging = tuning.tune(robot)
    upright = tuning.tune(dataclasses.replace(robot, gravity_compensation=True))
    assert max(abs(r.error) for r in sagging.after) > 0.01 > 1e-4 > max(abs(r.error) for r in upright.after)
    # joint2 carries the arm: gravity's share of its effort is free for stiffness
    assert upright.tuned.arm.stiffness[1] > sagging.tuned.arm.stiffness[1]


def test_the_fingers_of_a_linkage():
    tuned = tuning.tune(registry.robot("cobotta_pro_900"))
    left, right = tuned.after[-2:]
    assert (left.step, right.step) == pytest.approx((0.1, -0.1))
    assert (left.error, right.error) == pytest.approx((0, 0), abs=1e-3)


def test_an_arm_without_a_gripper():
    robot = dataclasses.replace(registry.robot("nero"), gripper=GripperCfg())
    tuned = tuning.tune(robot)
    assert len(tuned.after) == 7 and list(tuning.gains(tuned.tuned)) == list(robot.arm.joints)


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ({"step": 0.0}, "step takes a number above 0, got 0"),
        ({"step": math.nan}, "step takes a number above 0, got nan"),
        ({"frequency": -1.0}, "frequency takes a number above 0, got -1"),
        ({"frequency": 30.0}, "a physics step of 0.01 s cannot follow 30 Hz: at most 15.9 Hz, or a smaller dt"),
        ({"sim": SimCfg(dt=0.0)}, "dt takes a physics step from 0.0001 to 0.1 s, got 0"),
    ],
)
def test_numbers_out_of_range(bad, message):
    with pytest.raises(UserError, match=message):
        tuning.tune(registry.robot("nero"), **bad)


@pytest.mark.parametrize("width", [80, 160])
def test_tables_have_a_line_a_joint(tuned, width):
    screen = Console(width=width)
    for view in tuning.table(tuned):
        with screen.capture() as said:
            screen.print(view)
        counts = {said.get().split().count(joint) for joint in tuned.robot.joints}  # at 80 columns, once in every part
        assert len(counts) == 1 and 1 <= counts.pop() <= (1 if width == 160 else 3)


# --- the program


@pytest.fixture
def call(call, monkeypatch):
    """``call("--robot", ...) -> (exit status, stdout, stderr)``, not a terminal."""
    monkeypatch.delenv("COLUMNS")
    return functools.partial(call, "mjx_nero", "tune-gains")


def test_program_writes_gains_and_plot(call, tmp_path):
    code, out, err = call("--robot", "nero", "--out", "gains.yaml", "--plot", "gains.png", "--frequency", "4")
    assert (code, err) == (0, "") and "plot: gains.png" in out and "gains: gains.yaml" in out
    assert {p.name for p in tmp_path.iterdir()} == {"gains.yaml", "gains.png"}
    picture = imageio.imread(tmp_path / "gains.png")
    assert picture.shape[0] > 500 and picture.shape[1] > 1000 and picture[..., :3].std() > 5
    written = yaml.safe_load((tmp_path / "gains.yaml").read_text())
    robot = registry.robot("nero")
    assert list(written) == list(robot.joints)
    assert all(list(row) == ["stiffness", "damping", "effort", "speed"] for row in written.values())
    assert all(value == float(f"{value:.3g}") for row in written.values() for value in row.values())
    assert [row["effort"] for row in written.values()] == [25.0] * 7 + [22.0] * 2
    # joint7: 0.0133 kg m^2 wherever the arm is, so 0.64 of that at 4 Hz
    assert written["joint7"]["stiffness"] == pytest.approx((8 * math.pi) ** 2 * 0.64 * 0.0133, rel=0.01)


def test_program_can_compensate_gravity(call):
    code, out, _ = call("--robot", "nero", "--gravity-compensation")
    (line,) = [row for row in out.splitlines() if " joint2 " in row and " .. " in row]
    assert code == 0 and line.split()[4] == "0.00"


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        ([], "the following arguments are required: --robot"),
        (["--robot", "neero"], "no robot 'neero' (did you mean 'nero'?)"),
        (["--robot", "nero", "--step", "-1"], "--step must be above 0, got '-1'"),
        (["--robot", "nero", "--dt", "0"], "--dt must be above 0, got '0'"),
        (["--robot", "nero", "--dt", "1"], "dt takes a physics step from 0.0001 to 0.1 s, got 1"),
        (["--robot", "nero", "--frequency", "x"], "--frequency takes a finite number, got 'x'"),
        (["--robot", "nero", "--out", "nowhere/g.yaml"], "cannot write nowhere/g.yaml: the folder nowhere does not exist"),
        (["--robot", "nero", "--plot", "."], "--plot takes a name that ends in .png"),
        (
            ["--robot", "nero", "--out", "g.yaml", "--plot", "g.xyz"],
            "--plot takes a name that ends in .png or .pdf or .svg, got 'g.xyz'",
        ),
        (["--robot", "nero", "--speed", "1"], "unknown argument '--speed'"),
    ],
)
def test_mistakes_end_in_one_line_and_leave_nothing(call, tmp_path, argv, message):
    code, _, err = call(*argv)
    assert code == 2 and err.startswith(f"error: {message}") and err.count("\n") == 1
    assert not list(tmp_path.iterdir())
