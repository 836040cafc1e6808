"""The gripper's demo: what it measures, its table and files, and mistakes that end in one line."""

import functools

import imageio.v3 as imageio
import numpy as np
import pytest
from rich.console import Console

import mjx_nero
from mjx_nero.tools import gripper_demo
from mjx_nero.types import UserError

OPENED = {"nero": 0.1, "cobotta": 0.1514}  # gaps at the ends of the joints' ranges [m]: assets/*/README.md
STEPS = {"nero": 2 * 0.004, "cobotta": 2 * 0.08 * 0.1}  # most that the gap leads by: two fingers, 8% of a joint's range


@pytest.fixture(scope="module", params=["nero", "cobotta"])
def played(request):
    env = mjx_nero.make(f"{request.param}_lift", impl="native")
    return request.param, env, gripper_demo.demo(env, cycles=2, seconds=1.2)


def ends(motion):
    return [motion.measured[motion.movement == m][-1] for m in range(4)]


def test_closes_and_opens_all_the_way(played):
    robot, env, motion = played
    assert motion.start == pytest.approx({"nero": 0.1, "cobotta": 0.0937}[robot], abs=1e-4)
    np.testing.assert_allclose(ends(motion), [0, OPENED[robot], 0, OPENED[robot]], atol=1e-3)
    assert len(motion.time) == 4 * round(1.2 / env.dt) and motion.time[-1] == pytest.approx(4.8)


def test_measured_follows_commanded(played):
    robot, _, motion = played
    lead = motion.commanded - np.concatenate([[motion.start], motion.measured[:-1]])
    closing = motion.movement % 2 == 0
    assert np.all(lead[closing] <= 1e-3) and np.all(lead[~closing] >= -1e-3)
    assert 0.5 * STEPS[robot] < np.abs(lead).max() < 1.05 * STEPS[robot]
    for m in range(4):
        part = motion.movement == m
        steps = np.diff(motion.measured[part]) * (1 if m % 2 else -1)
        assert steps.min() > -1e-3  # no swinging back
        assert abs(motion.measured[part][-1] - motion.commanded[part][-1]) < 2e-4


def test_the_arm_stays_at_home():
    env = mjx_nero.make("cobotta_lift", impl="native")
    motion = gripper_demo.demo(env, cycles=1, seconds=0.5)
    arm = [env.physics_model.joint(j).qposadr[0] for j in env.cfg.robot.arm.joints]
    assert np.abs(motion.qpos[:, arm] - np.array(env.cfg.robot.arm.home)).max() < 0.01


def test_a_smaller_step_is_slower():
    env = mjx_nero.make("cobotta_lift", impl="native")
    slow, fast = (gripper_demo.demo(env, cycles=1, delta=delta, seconds=0.4).measured[19] for delta in (0.02, 0.1))
    assert 0.0 < slow - fast and fast < 0.01 < 0.07 < slow


@pytest.mark.parametrize("bad", [{"delta": 0.0}, {"delta": -0.1}, {"delta": float("nan")}, {"seconds": float("inf")}])
def test_steps_and_times_are_above_zero(bad):
    (name, value), *_ = bad.items()
    with pytest.raises(UserError, match=f"{name} takes a number above 0, got {value:g}"):
        gripper_demo.demo(mjx_nero.make("nero_lift", impl="native"), **bad)


def printed(motion):
    console = Console(width=120)
    with console.capture() as said:
        console.print(gripper_demo.table(motion))
    return said.get()


def test_table_has_a_line_a_movement(played):
    text = printed(played[2])
    assert "[mm]" in text and "[s]" in text
    assert text.count("closes") == text.count("opens") == 2 and "not there" not in text


def test_table_tells_what_never_arrives():
    motion = gripper_demo.demo(mjx_nero.make("cobotta_lift", impl="native"), cycles=1, delta=0.02, seconds=0.2)
    assert printed(motion).count("not there") == 2


@pytest.fixture
def call(call):
    """``call("--env", ...) -> (exit status, stdout, stderr)``."""
    return functools.partial(call, "mjx_nero", "gripper-demo")


@pytest.mark.filterwarnings("ignore:os.fork")  # the video is read by a child process, and JAX warns of every fork
def test_program_writes_the_plot_and_the_video(call, tmp_path):
    code, out, err = call("--cycles", "1", "--seconds", "0.8", "--delta", "0.1", "--out", "gap.png", "--video", "gap.mp4")
    assert "closes" in out and "plot: gap.png" in out
    picture = imageio.imread(tmp_path / "gap.png")
    assert picture.shape[0] > 300 and picture.shape[1] > 600 and picture[..., :3].std() > 5
    if "no offscreen OpenGL" in err:
        assert (code, len(list(tmp_path.iterdir()))) == (2, 1)
        return
    assert (code, {p.name for p in tmp_path.iterdir()}) == (0, {"gap.png", "gap.mp4"})
    film = imageio.imread(tmp_path / "gap.mp4")
    rate = imageio.immeta(tmp_path / "gap.mp4")["fps"]  # as fast as this machine draws, and real time
    assert len(film) == pytest.approx(1.6 * rate, abs=1)
    assert np.abs(film[0].astype(float) - film[10]).max() > 50  # the gripper has moved


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["--env", "cobotta_lfit"], "unknown env 'cobotta_lfit' (did you mean 'cobotta_lift'?)"),
        (["--cycles", "0"], "--cycles must be at least 1, got '0'"),
        (["--delta", "-1"], "--delta must be above 0, got '-1'"),
        (["--out", "nowhere/gap.png"], "cannot write nowhere/gap.png: the folder nowhere does not exist"),
        (["--video", "nowhere/gap.mp4"], "cannot write nowhere/gap.mp4: the folder nowhere does not exist"),
        (["--out", "."], "--out takes a name that ends in .png or .pdf or .svg, got '.'"),
        (["--cycles", "1", "--seconds", "0.1", "--out", "gap.xyz"], "--out takes a name that ends in .png"),
        (["--speed", "1"], "unknown argument '--speed'"),
    ],
)
def test_mistakes_end_in_one_line_and_leave_nothing(call, tmp_path, argv, message):
    code, _, err = call(*argv)
    assert code == 2 and err.startswith(f"error: {message}") and err.count("\n") == 1
    assert not list(tmp_path.iterdir())
