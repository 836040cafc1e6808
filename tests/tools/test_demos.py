"""The command ``demos``: what it writes, shows and plays again. Physics is MuJoCo's, in a task of a fifth of a second."""

import itertools
import json
import pathlib
import re

import imageio.v3 as imageio
import mujoco
import numpy as np
import pytest

from mjx_nero.data import Episode, open_dataset, units
from mjx_nero.data import episode as names
from mjx_nero.tasks import registry
from mjx_nero.tools import cli, demos
from mjx_nero.tools.demos import command, making
from mjx_nero.tools.demos.cfg import DemosCfg

SHORT = ["--env", "nero_lift", "--agent", "policy", "--all", "--form", "arrays", "--env.episode_length_s", 0.2]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Six episodes of ten steps, with noise and velocities, in pieces of four."""
    where = tmp_path_factory.mktemp("demos") / "d"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cli, "setup_jax", lambda: None)
        demos.main(
            [*map(str, SHORT), "--episodes", "6", "--side-by-side", "4", "--noise", "0.5", "--velocities", "--out", str(where)]
        )
    return where


def test_what_a_step_holds(made):
    found = open_dataset(made)
    assert found.lengths.tolist() == [10] * 6 and found.numbers.tolist() == list(range(6)) and not found.success.any()
    joints = [f"joint{i}.pos" for i in range(1, 8)] + ["gripper_joint1.pos", "gripper_joint2.pos"]
    for name in (names.ACTION, names.EXECUTED):
        assert list(found.schema.features[name].names) == joints
    state = found.schema.features[names.STATE]
    assert list(state.names) == joints + [joint.replace(".pos", ".vel") for joint in joints]
    assert state.units == ("rad",) * 7 + ("m",) * 2 + ("rad/s",) * 7 + ("m/s",) * 2
    assert found.schema.fps == pytest.approx(50) and found.schema.task == "Pick up the cube and hold it at the goal."
    assert found.schema.about["noise"] == 0.5 and found.schema.about["env_fields"] == {"episode_length_s": "0.2"}
    pos, vel = np.split(found.column(names.STATE), 2, axis=1)
    np.testing.assert_array_equal(pos, found.column(names.QPOS)[:, :9])
    seen = found.schema.features[names.SEEN]
    assert seen.names[0] == "joint_pos.0" and seen.size == found.column(names.SEEN).shape[1]
    home = np.array(registry.robot("nero").home, np.float32)
    np.testing.assert_allclose(found.column(names.SEEN)[:, :9], pos - home, atol=1e-6)  # no noise on it
    np.testing.assert_allclose(found.column(names.SEEN)[:, 9:18], vel, atol=1e-6)
    place = [found.schema.features[names.ENVIRONMENT].names.index(f"cube.{axis}") for axis in "xyz"]
    np.testing.assert_array_equal(found.column(names.ENVIRONMENT)[:, place], found.column(names.QPOS)[:, 9:12])
    ends = found.column(names.DONE).reshape(6, 10)
    assert ends[:, -1].all() and not ends[:, :-1].any()


def test_labels_stand_beside_what_noise_made_of_them(made):
    """The arm's targets differ, the fingers' do not; a label is what a policy without noise would tell the drives there, at once:
    set-points follow the velocities that it asks for by 1 - exp(-0.02 / 0.15), and at first are at the joints."""
    found = open_dataset(made)
    off = (found.column(names.EXECUTED) - found.column(names.ACTION)).reshape(6, 10, 9)
    assert np.abs(off[..., :7]).max() > 1e-3 and np.abs(off[..., 7:]).max() == 0
    assert len(np.unique(off[:, 5], axis=0)) == 6  # each episode has its own
    arm, share = registry.robot("nero").arm, 1 - np.exp(-0.02 / 0.15)
    rate = share * np.clip(found.column(names.DONE_BY).reshape(6, 10, 8)[:, 0, :7], -1, 1)
    wanted = np.array(arm.home) + (0.02 + np.array(arm.lead)) * np.array(arm.speed) * rate
    first = found.column(names.ACTION).reshape(6, 10, 9)[:, 0, :7]
    free = np.abs(first - np.array(arm.home)) < 0.05  # of limits of joints
    np.testing.assert_allclose(first[free], wanted[free], atol=1e-4)
    assert free.sum() > 10


def test_an_episode_is_drawn_by_its_number(made, call, tmp_path):
    """Whatever plays beside it; and a data set goes on where it ended."""
    argv = [*SHORT, "--side-by-side", 4, "--noise", 0.5, "--out", "d"]
    assert call("mjx_nero", "demos", *argv, "--episodes", 3)[0] == 0
    code, out, err = call("mjx_nero", "demos", *argv, "--episodes", 6)
    assert code == 0 and "3 new, from 3 played" in out, err
    one, other = open_dataset(made), open_dataset(tmp_path / "d")
    for name in (names.QPOS, names.EXECUTED, names.SEEN):
        np.testing.assert_array_equal(one.column(name), other.column(name))
    code, _, err = call("mjx_nero", "demos", *argv, "--episodes", 9, "--seed", 1)
    assert code == 2 and "holds other demonstrations (seed was 0, here it is 1): pass another folder" in err


def test_no_more_is_played_than_is_to_be_kept():
    """Of every two episodes one succeeds."""
    episodes = (Episode({"x": np.zeros((1, 1))}, number % 2 == 1, number) for number in itertools.count())

    def take(most, all, wanted):
        kept, played = command._take(episodes, most, all, wanted)
        return [each.number for each in kept], played

    assert take(6, False, 2) == ([1, 3], 4)
    assert take(6, False, 0) == ([], 0)
    assert take(6, True, 3) == ([4, 5, 6], 3)
    assert take(4, False, 9) == ([7, 9], 4)


def test_an_episode_may_end_with_its_success(call, tmp_path):
    """It is the beginning of the whole one, to the bit, up to where the hand has been at the goal for 0.1 s, whatever plays
    beside it and before it. Both play three at once, since products of another number of rows are rounded differently."""
    argv = ["--env", "nero_reach", "--agent", "policy", "--all", "--form", "arrays", "--env.success.hold_s", 0.1]
    argv += ["--env.episode_length_s", 2.5, "--episodes", 7, "--side-by-side", 3]
    for flags in (["--out", "whole"], ["--ends", "success", "--out", "early"]):
        code, _, err = call("mjx_nero", "demos", *argv, *flags)
        assert code == 0, err
    cfg = registry.env_cfg("nero_reach")
    met, hold = cfg.success.condition.params, round(0.1 / (cfg.sim.dt * cfg.sim.decimation))
    whole, early = (open_dataset(tmp_path / name) for name in ("whole", "early"))
    assert early.numbers.tolist() == list(range(7)) and early.success.sum() >= 6
    at = [early.schema.features[names.ENVIRONMENT].names.index(f"{thing}.x") for thing in ("hand", "goal")]
    for one, part in zip(whole.episodes(), early.episodes(), strict=True):
        poses = one.arrays[names.ENVIRONMENT]
        hand, goal = (poses[1:, i : i + 7] for i in at)  # after each step
        there = np.linalg.norm(hand[:, :3] - goal[:, :3], axis=1) < met["threshold"]
        there &= 2 * np.arccos(np.clip(np.abs((hand[:, 3:] * goal[:, 3:]).sum(1)), 0, 1)) < met["angle"]
        held = np.convolve(there, np.ones(hold))[: len(there)] == hold
        length = int(held.argmax()) + 1 if held.any() else len(one)
        assert len(part) == length and part.success == (held.any() or one.success)
        for name in (names.QPOS, names.EXECUTED, names.SEEN, names.REWARD):
            np.testing.assert_array_equal(part.arrays[name], one.arrays[name][:length])
        ends = part.arrays[names.SUCCESS].ravel()
        assert ends[-1] == part.success and not ends[:-1].any() and part.arrays[names.DONE].ravel()[-1]
    assert early.lengths.mean() < 0.8 * whole.lengths.mean()


def test_a_number_has_its_slot_wherever_one_begins():
    """A program rounds not all rows of a batch alike, and a data set that goes on has to be the same to the bit."""
    fields = {"episode_length_s": 0.2}
    player = making.prepare(DemosCfg("nero_lift", agent="policy", episodes=7, side_by_side=3, ends="success", env_fields=fields))[
        1
    ]
    play, slots = player._play, []
    player._play = lambda state, numbers, key: (slots.append(np.asarray(numbers) % 3), play(state, numbers, key))[1]
    assert [episode.number for episode in itertools.islice(player(5, 0), 7)] == list(range(5, 12))
    assert len(slots) >= 3 and (np.array(slots) == [0, 1, 2]).all()


def test_it_is_shown_and_played_again(made, call):
    code, out, err = call("mjx_nero", "demos", "--inspect", made)
    assert code == 0, err
    assert "6, of which 0 succeed (6 were played)" in out and "60, 0.00 h" in out and "cube.z" in out
    code, out, err = call("mjx_nero", "demos", "--replay", made, "--episode", 5)
    assert code == 0 and "episode 5 (number 5): 10 steps, fails" in out, err
    assert float(out.split("differs from the recording by at most ")[1].split()[0]) < 1e-4
    code, _, err = call("mjx_nero", "demos", "--replay", made, "--episode", 6)
    assert code == 2 and "/d has 6 episodes: --episode takes a number from 0 to 5" in err


def test_the_guides_python_runs(made, monkeypatch, tmp_path, capsys):
    page = (pathlib.Path(__file__).parents[2] / "docs" / "guides" / "demonstrations.md").read_text()
    (snippet,) = re.findall(r"^```python\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    (tmp_path / "demos").mkdir()
    (tmp_path / "demos" / "stack").symlink_to(made)
    monkeypatch.chdir(tmp_path)
    exec(snippet, {})
    assert capsys.readouterr().out.startswith("6 ('joint1.pos', ")


def test_units_of_lerobots_robots_by_hand():
    """Of the SO-ARM101's gripper, 0 is closed and 100 open; its hinges are in degrees."""
    low, high = np.array([-np.pi, -0.2]), np.array([np.pi, 1.8])
    made = units.lerobot("so_arm101", [False, False], low, high, np.array([True]))
    np.testing.assert_allclose(made.shown(np.array([np.pi / 2, 0.3])), [90, 25], rtol=1e-6)
    assert made.names == ("deg", "%")
    other = units.lerobot("so_arm100", [False, False], np.array([0.0, -1.8]), np.array([np.pi, 0.2]), np.array([False]))
    np.testing.assert_allclose(other.shown(np.array([np.pi / 2, 0.2])), [0, 0], atol=1e-5)
    back = units.from_json(json.loads(json.dumps(made.to_json())))
    np.testing.assert_allclose(back.positions(back.shown(np.array([0.4, 1.1]))), [0.4, 1.1], rtol=1e-6)


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        ([], "demos takes exactly one of --out DIR (write), --inspect DIR (show) and --replay DIR"),
        (["--out", "d", "--inspect", "d"], "demos takes exactly one of"),
        (["--out", "d", "--policy", "p.safetensors"], "--policy needs --agent policy"),
        (["--out", "d", "--agent", "policy", "--through", "task"], "--through is for experts"),
        (["--out", "d", "--agent", "juggler"], "'juggler' cannot play nero_lift: choose one of policy, expert, pick_up"),
        (["--out", "d", "--agent", "random"], "--agent random demonstrates nothing: choose policy, expert or a controller"),
        (
            ["--out", "d", "--agent", "policy", "--side-by-side", 65536, "--episodes", 65536, "--env.episode_length_s", 3000],
            "--side-by-side 65,536 with",
        ),
        (["--inspect", "d"], "d holds no demonstrations of mjx_nero: give a folder that 'demos --out' wrote"),
        (["--video", "v.mp4", "--inspect", "d"], "--video shows a replayed episode"),
    ],
)
def test_mistakes_are_one_line_and_leave_nothing(argv, message, call, tmp_path):
    code, _, err = call("mjx_nero", "demos", *argv)
    assert code == 2 and message in err and err.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_the_ray_tracer_needs_no_opengl(monkeypatch):
    """Not even to make an environment, as nothing is drawn while an agent plays."""

    def missing(*args, **kwargs):
        raise AssertionError("MuJoCo's renderer was made")

    monkeypatch.setattr(mujoco, "Renderer", missing)
    cfg = DemosCfg("nero_lift", "rgb", agent="policy", cameras="front", renderer="warp", picture="16x16", episodes=1)
    schema, player = making.prepare(cfg)
    assert schema.about["renderer"] == "warp" and schema.features[names.PICTURES + "front"].picture == (16, 16)
    player.close()


def test_pictures_of_a_scenes_cameras_look_different_from_episode_to_episode(call, tmp_path):
    """The bundled policy acts, told where the cube is; both cameras see it as the preset has it looks. Of a step there is what
    LeRobot's policies learn from, and no more."""
    argv = [*SHORT, "--preset", "rgb", "--episodes", 3, "--cameras", "front,wrist", "--holds", "lerobot", "--out", "d"]
    code, _, err = call("mjx_nero", "demos", *argv)
    assert code == 0, err
    found = open_dataset(tmp_path / "d")
    assert set(found.schema.features) == {*making.HOLDS["lerobot"], *(names.PICTURES + name for name in ("front", "wrist"))}
    told = found.schema.features[names.ENVIRONMENT].names  # who sees is told the goal alone, and learns no more from LeRobot
    assert told == tuple(f"goal.{axis}" for axis in ("x", "y", "z", "qw", "qx", "qy", "qz"))
    assert found.column(names.ENVIRONMENT)[:, :3].std(axis=0).max() > 0.01
    for camera in ("front", "wrist"):
        frames = found.column(names.PICTURES + camera).reshape(3, 10, 64, 64, 3)
        assert frames.std() > 10
        first = frames[:, 0].reshape(3, -1, 3).mean(axis=1)
        assert np.abs(first[0] - first[1]).max() > 2 and np.abs(first[1] - first[2]).max() > 2  # of 255
    code, out, _ = call("mjx_nero", "demos", "--inspect", "d", "--sheet", "sheet.png")
    assert code == 0 and "pictures: sheet.png" in out
    assert imageio.imread(tmp_path / "sheet.png").shape[1] % (6 * 64) == 0  # three moments by two cameras
    code, _, err = call("mjx_nero", "demos", *argv[:-1], "e", "--cameras", "ceiling")
    assert code == 2 and "this environment has no camera ceiling: choose from front, wrist, side" in err
