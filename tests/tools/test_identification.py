"""Identification of drives: logs, excitation, and parameters found again that were put in."""

import dataclasses

import numpy as np
import pytest
import yaml

from mjx_nero import UserError, __main__
from mjx_nero.envs import identified
from mjx_nero.identify import Drives, Log, Plant, RecordCfg, identify, record
from mjx_nero.identify import fit as fitting
from mjx_nero.identify import log as logs
from mjx_nero.identify.excitation import RATE, sweeps
from mjx_nero.identify.plant import POSITIVE, in_force, usual_step
from mjx_nero.mdp import actions, randomization
from mjx_nero.sim.robot import DriveCfg, RobotCfg
from mjx_nero.tasks import registry
from mjx_nero.tools.identification.report import plot, save, save_plot

SHAPE = '<geom type="capsule" size="0.03" fromto="0 0 0 0.3 0 0" mass="0.8"/>'
LINK = '<joint name="{}" axis="0 1 0" range="-2 2" armature="0.02"/>' + SHAPE
ARM = RobotCfg(  # two links that swing in a vertical plane
    name="planar",
    mjcf=f"""<mujoco><compiler angle="radian"/><worldbody><body name="base_link" pos="0 0 1.5">
    <body name="upper">{LINK.format("shoulder")}<body name="lower" pos="0.3 0 0">{LINK.format("elbow")}
    <site name="ee" pos="0.3 0 0"/></body></body></body></worldbody></mujoco>""",
    arm=DriveCfg(("shoulder", "elbow"), (60.0, 30.0), (6.0, 3.0), (30.0, 15.0), (3.0, 3.0), (0.4, 0.6)),
)


@pytest.fixture(scope="module")
def plant():
    return Plant(ARM, 0.005)


def test_a_step_gets_the_mean_of_the_targets_in_force():
    """Targets 1, 3, 0 from 0.0, 0.1 and 0.15 s on, in steps of 0.1 s: the second step has 3 in its first half, 0 in the other."""
    means = in_force(np.array([0.0, 0.1, 0.15]), np.array([[1.0], [3.0], [0.0]]), np.array([-0.1, 0.0, 0.1, 0.2, 0.3]))
    np.testing.assert_allclose(means[:, 0], [1.0, 1.0, 1.5, 0.0], atol=1e-12)


def test_a_drive_at_rest_sags_under_its_load_and_reads_beside_its_joint(plant):
    """A joint rests where stiffness (target - q) is the load of the links beyond it."""
    drives = dataclasses.replace(plant.nominal, friction=np.full(2, 1e-9), offset=np.array([0.1, -0.2]))
    sent, targets = np.zeros(1), np.array([[0.4, 0.6]])
    times = np.array([5.0])
    (readings,) = plant.readings([drives], sent, targets, targets[0], times)
    q1, q2 = readings[0] - [0.1, -0.2]
    # Axis y: positive angles turn +x down, so weights pull towards larger angles.
    lower = 0.8 * 9.81 * 0.15 * np.cos(q1 + q2)
    upper = 0.8 * 9.81 * (0.15 + 0.3) * np.cos(q1) + lower
    np.testing.assert_allclose([60 * (q1 - 0.4), 30 * (q2 - 0.6)], [upper, lower], rtol=1e-4)


@pytest.mark.parametrize("name", registry.list_robots())
def test_an_excitation_keeps_within_what_the_arm_can(name):
    robot = registry.robot(name)
    targets = sweeps(robot, 20.0)
    model = Plant(robot, 0.01).model
    low, high = np.array([model.joint(j).range for j in robot.arm.joints]).T
    assert (targets > low).all() and (targets < high).all()
    assert (np.abs(np.diff(targets, axis=0)) * RATE <= np.array(robot.arm.speed)).all()
    assert (targets[: round(1.4 * RATE)] == targets[0]).all() and (np.ptp(targets, axis=0) > 0.05).all()


def test_links_that_would_meet_swing_less():
    """A wall stands 5 cm before the lower link's end, whose reach grows by 16 cm where both joints swing by half a radian."""
    wall = '<body name="wall" pos="0.53 0 1.0"><geom name="wall" type="box" size="0.01 0.5 1"/></body>'
    free = sweeps(ARM, 20.0)
    walled = dataclasses.replace(ARM, mjcf=ARM.mjcf.replace("</worldbody>", f"{wall}</worldbody>"), arm=ARM.arm)
    near = sweeps(walled, 20.0)
    assert np.ptp(near, axis=0).max() <= np.ptp(free, axis=0).max() / 2 * (1 + 1e-6)


def check(plant, seed, seconds=30.0):
    cfg = RecordCfg(seconds=seconds, noise=1e-4, resolution=1e-4, scatter=1.5, offset=0.02, delay=0.06, seed=seed)
    log, truth = record(plant, cfg)
    return log, truth, identify(plant, log)


@pytest.mark.slow
def test_what_was_put_in_is_found_again(plant, tmp_path):
    inside = []
    for seed in range(3):
        log, truth, fit = check(plant, seed)
        for name in POSITIVE:
            np.testing.assert_allclose(getattr(fit.drives, name), getattr(truth, name), rtol=0.05, err_msg=name)
        assert abs(fit.drives.delay - truth.delay) < 2e-3
        inside += [(fit.low.vector() <= truth.vector()) & (truth.vector() <= fit.high.vector())]
        assert (fit.rms < 1.2e-4).all() and (fit.nominal_rms > 1e-3).all()  # noise, and a count's 1e-4 / sqrt(12)
    assert np.mean(inside) >= 0.9

    save_plot(tmp_path / "fit.png", ARM.arm.joints, log, fit)
    assert (tmp_path / "fit.png").read_bytes()[:4] == b"\x89PNG"
    save(tmp_path / "fit.yaml", "planar", "log.csv", ARM.arm.joints, fit)
    found = identified.read(tmp_path / "fit.yaml")
    assert found.joints["elbow"].stiffness.value == pytest.approx(truth.stiffness[1], rel=0.05)
    assert found.delay.low <= found.delay.value <= found.delay.high


@pytest.mark.parametrize(("noise", "error"), [(1e-4, 0.1), (1.1e-6, 1e-3), (3e-5, 20.0), (0.05, 0.1), (1e-4, 1e-4)])
@pytest.mark.parametrize("count", [1, 4, 7])
def test_no_two_numbers_of_the_plot_overlap(noise, error, count):
    """The numbers beside each panel stand apart, and the lowest panel of each column has the times below it."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    times = np.linspace(0, 60, 600)
    wave = np.sin(times)[:, None] * np.ones(count)
    log = logs.Log(times=times, positions=np.zeros_like(wave), sent=times[:1], targets=np.zeros((1, count)))
    drives, held = dataclasses.replace(Plant(ARM, 0.005).nominal), times > 45
    fit = fitting.Fit(drives, drives, drives, noise * wave, error * wave, held, np.full(count, noise), np.full(count, error))
    figure = Figure(figsize=(12, 0.8 + 2.2 * -(-count // 3)), layout="constrained")
    plot([f"joint{i}" for i in range(count)], log, fit, figure)
    FigureCanvasAgg(figure).draw()
    for panel in figure.axes[:count]:
        low, high = panel.get_window_extent().extents[[1, 3]]
        boxes = [label.get_window_extent().extents for label in panel.get_yticklabels() if label.get_text()]
        boxes = sorted((box[1], box[3]) for box in boxes if low - 1 <= (box[1] + box[3]) / 2 <= high + 1)
        assert len(boxes) > 1 and all(above[0] > below[1] for below, above in zip(boxes, boxes[1:], strict=False))
    lowest = figure.axes[max(0, count - 3) : count]
    assert all(any(label.get_visible() and label.get_text() for label in panel.get_xticklabels()) for panel in lowest)


@pytest.mark.slow
@pytest.mark.parametrize("solve", [1, 2])
def test_a_search_that_comes_to_rest_beside_the_best_begins_again(plant, monkeypatch, solve):
    """Where the first (1) or the second (2) search over all of the log says five times the armature, the other one counts."""
    log, truth = record(plant, RecordCfg(seconds=30.0, noise=1e-4, scatter=1.5, delay=0.06, seed=0))
    begun, real = [], fitting._solve

    def stuck(plant, log, part, x, enough):
        begun.append(x)
        found = real(plant, log, part, x, enough)
        if len(begun) == solve + 1:
            found.x, found.cost = np.where(np.isin(np.arange(len(x)), (4, 5)), 5 * found.x, found.x), 10 * found.cost
        return found

    monkeypatch.setattr(fitting, "_solve", stuck)
    np.testing.assert_allclose(identify(plant, log).drives.armature, truth.armature, rtol=0.05)
    np.testing.assert_array_equal(begun[2][4:6], plant.nominal.armature)


def test_a_log_is_read_as_it_was_written(tmp_path):
    log = Log(
        np.arange(600) * 0.02, np.random.default_rng(0).uniform(-1, 1, (600, 2)), np.arange(1200) * 0.01, np.ones((1200, 2))
    )
    logs.write(tmp_path / "log.csv", log, ("a", "b"), ["a note"])
    again = logs.read(tmp_path / "log.csv", ("a", "b"))
    for name in ("sent", "targets", "times", "positions"):
        np.testing.assert_allclose(getattr(again, name), getattr(log, name), rtol=1e-6)
    swapped = logs.read(tmp_path / "log.csv", ("b", "a"))
    np.testing.assert_allclose(swapped.targets, again.targets[:, ::-1])


HEAD = "time,target.a,position.a\n"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "needs exactly one column time"),
        (b"\xff\xfe", "is not text"),
        (b"time,target.a,position.b\n", "needs exactly one column position.a"),
        (b"time,target.a,position.a,time\n", "needs exactly one column time"),
        ((HEAD + "0,1\n").encode(), "line 2 has 2 cells, the first line 3"),
        ((HEAD + "0,1,x\n").encode(), "line 2 position.a takes a number up to 10000, got 'x'"),
        ((HEAD + "0,1,nan\n").encode(), "line 2 position.a takes a number"),
        ((HEAD + "0,1,1e300\n").encode(), "line 2 position.a takes a number"),
        ((HEAD + "0,1,1\n0,,1\n").encode(), "every row needs a time, and times must ascend"),
        ((HEAD + "0,,1\n1,1,1\n").encode(), "the first row needs the targets"),
        ((HEAD + "0,1,1\n1,1,1\n").encode(), "has 2 readings: 500 or more over 10 s or more are needed"),
    ],
)
def test_a_bad_log_is_one_line(tmp_path, content, message):
    path = tmp_path / "log.csv"
    path.write_bytes(content)
    with pytest.raises(UserError, match=message):
        logs.read(path, ("a",))


def content(arm, robot="nero"):
    def number(x):
        return {"value": x, "low": 0.9 * x, "high": 1.1 * x}

    rows = {
        "stiffness": arm.stiffness,
        "damping": arm.damping,
        "armature": (0.02,) * 7,
        "friction": (0.3,) * 7,
        "offset": (0.0,) * 7,
    }
    joints = {j: {name: number(values[i]) for name, values in rows.items()} for i, j in enumerate(arm.joints)}
    return {"robot": robot, "delay": {"value": 0.031, "low": 0.03, "high": 0.032}, "joints": joints}


def test_identified_drives_take_the_place_of_a_robots_own(tmp_path):
    arm = dataclasses.replace(registry.robot("nero").arm, stiffness=(150.0,) * 7, damping=(20.0,) * 7)
    path = tmp_path / "drives.yaml"
    path.write_text(yaml.safe_dump(content(arm)))
    cfg = identified.applied(registry.env_cfg("nero_lift", "isaac", identified=str(path)))
    assert cfg.robot.arm.stiffness == (150.0,) * 7 and cfg.robot.arm.damping == (20.0,) * 7
    first = next(iter(cfg.randomization.values()))
    assert first.func is randomization.drives and first.params["stiffness"][0] == pytest.approx((135.0, 165.0))
    # 30 to 32 ms at 20 ms a control step: one or two.
    assert next(iter(cfg.actions.values())).func is actions.Delay and cfg.actions["delay"].params["steps"] == (1, 2)
    both = identified.applied(registry.env_cfg("nero_lift", identified=str(path)))  # whose own are none or one
    assert both.actions["delay"].params["steps"] == (0, 2)
    wide = identified.applied(registry.env_cfg("nero_lift", "sim2real", identified=str(path)))
    assert wide.actions["delay"].params["steps"] == (0, 3) and list(wide.randomization)[:2] == ["identified", "link_mass"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"robot": "piper"}, "is for piper with joints"),
        ({"delay": {"value": 1.0, "low": 2.0, "high": 3.0}}, "delay takes low <= value <= high"),
        ({"delay": {"value": "x", "low": 2.0, "high": 3.0}}, "delay.value takes a finite number"),
        ({"more": 1}, "no key 'more'"),
    ],
)
def test_a_bad_file_of_drives_is_one_line(tmp_path, change, message):
    path = tmp_path / "drives.yaml"
    path.write_text(yaml.safe_dump(content(registry.robot("nero").arm) | change))
    with pytest.raises(UserError, match=f"^{path}.*{message}"):
        identified.applied(registry.env_cfg("nero_lift", identified=str(path)))


def test_the_commands_write_and_refuse_in_one_line(tmp_path, capsys):
    out = tmp_path / "log.csv"
    __main__.main(["record", "--robot", "so_arm101", "--out", str(out), "--seconds", "12", "--rate", "100", "--delay", "0.02"])
    log = logs.read(out, registry.robot("so_arm101").arm.joints)
    assert len(log.times) == 1200 and len(log.sent) == 600 and "log.csv" in capsys.readouterr().out
    for argv, message in (
        (["record", "--robot", "nero", "--out", str(out), "--seconds", "3"], "the movement takes at least 6 s, got 3"),
        (["record", "--robot", "nero", "--out", str(out), "--dt", "0.5"], "dt takes a physics step from 0.0001 to 0.02 s"),
        (["record", "--robot", "nero", "--out", str(out), "--rate", "0.1"], "--rate must be at least 1"),
        (["record", "--robot", "nero", "--out", str(out), "--port", "can0"], "--port: only for --arm, pass it, too"),
        (
            ["record", "--robot", "nero", "--out", str(out), "--arm", "nero", "--emulate", "--noise", "1e-4"],
            "--noise: only for a simulated arm, leave out --arm",
        ),
        (["identify", str(out), "--robot", "nero"], "is a log of .so_arm101., but the robot is nero"),
        (["identify", str(tmp_path / "none.csv"), "--robot", "nero"], "there is no file"),
    ):
        with pytest.raises(UserError, match=message):
            __main__.main(argv)


def test_drives_are_their_vector():
    x = np.arange(11.0)
    drives = Drives.of(x)
    np.testing.assert_array_equal(drives.vector(), x)
    assert drives.damping.tolist() == [2.0, 3.0] and drives.delay == 10.0


def stiff(stiffness=(3000.0, 1000.0), damping=(8.0, 2.0)):
    """The arm with servos that oscillate at 150 and 190 rad/s."""
    return dataclasses.replace(ARM, arm=dataclasses.replace(ARM.arm, stiffness=stiffness, damping=damping))


def test_the_usual_step_resolves_drives_that_oscillate():
    assert usual_step(ARM) == 0.005  # at 33 rad/s
    assert usual_step(stiff()) == 0.00125
    assert usual_step(stiff(damping=(60.0, 20.0))) == 0.005  # damped too strongly to oscillate


@pytest.mark.slow
def test_intervals_count_the_error_of_the_physics_step():
    """A servo that oscillates within 35 ms cannot be known to 1% by steps of 5 ms, however small the remaining error is."""
    log, _ = record(Plant(stiff(), 0.0003125), RecordCfg(seconds=12.0, noise=1e-4, resolution=1e-4, scatter=1.2, delay=0.02))
    fit = identify(Plant(stiff(), 0.005), log)
    assert ((fit.high.stiffness - fit.drives.stiffness) / fit.drives.stiffness > 0.01).all()


@pytest.mark.parametrize(("noise", "factor"), [(0.0, fitting._ALIKE), (2e-3, 1.0)])
def test_intervals_are_wider_where_rounding_is_all_the_noise(noise, factor):
    """Noise of a count or more makes roundings independent of the motion."""
    count, times, rng = 1.5e-3, np.arange(2000) / 100, np.random.default_rng(0)
    path = np.sin(times)[:, None] * [0.5, 0.3]
    readings = count * np.round((path + noise * rng.standard_normal(path.shape)) / count)
    log = Log(times[:1], path[:1], times, readings)
    assert fitting._count(log) == pytest.approx(count, rel=1e-3)
    assert fitting._alike(log, path - readings) == factor
    assert fitting._noise(log) == pytest.approx(count / np.sqrt(12), rel=1e-3)
