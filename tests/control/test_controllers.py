"""Controllers at their tasks, end to end, in MuJoCo's C library: who arrives, how closely, and what is said where one cannot."""

import functools
import json

import numpy as np
import pytest

from mjx_nero.runs import evaluation

HOME = np.array([0.5, 0.0, 0.54])  # of the Cobotta's flange


@pytest.fixture(scope="module")
def play():
    """``play(env, preset, controller, episodes, **overrides) -> result``; what was played before is not played again."""

    @functools.cache
    def run(env, preset, controller, episodes, overrides):
        how = {"controller": controller, "episodes": episodes, "backend": "mujoco", "env_fields": dict(overrides)}
        return evaluation.play(evaluation.EvalCfg(env, preset, **how)).result

    def play(env, preset="default", controller=None, episodes=1, **overrides):
        return run(env, preset, controller, episodes, tuple(overrides.items()))

    return play


def at(x: float, y: float, z: float) -> dict:
    return {f"command.params.{name}": (value, value) for name, value in zip("xyz", (x, y, z), strict=True)}


def test_tracking_by_hand():
    """Six steps of two episodes: the mean over the last two steps, mean and largest over the second half."""
    distance = np.array([[9.0, 9.0], [9.0, 9.0], [9.0, 9.0], [4.0, 0.0], [1.0, 3.0], [1.0, 3.0]])
    want = {"position_error_mean": 2.0, "settled_error_mean": 2.0, "settled_error_max": 4.0}
    assert evaluation.tracking(distance, 2) == want
    assert evaluation.tracking(distance, 4)["position_error_mean"] == pytest.approx((9 + 9 + 4 + 0 + 1 + 3 + 1 + 3) / 8)


# --- following


def followed(call, tmp_path, x):
    """Three seconds of inverse kinematics towards a target at rest, ``x`` ahead [m]: what is printed, and the result."""
    dotted = [f"--env.{name}={value}" for name, value in at(x, 0.0, 0.5).items()] + ["--env.episode_length_s=3"]
    argv = ["--env", "cobotta_follow_target", "--preset", "static", "--agent", "ik", "--episodes", 1]
    code, out, err = call("eval", *argv, *dotted, "--json", "result.json")
    assert code == 0, err
    return out, err, json.loads((tmp_path / "result.json").read_text())


@pytest.mark.slow
def test_ik_arrives_and_says_so_in_json(call, tmp_path):
    out, err, result = followed(call, tmp_path, 0.5)
    assert err == "" and "ik" in out and "second half" in out and "grasped" not in out
    names = {"env", "preset", "controller", "episodes", "success_rate", "position_error_mean", "settled_error_max", "warning"}
    assert names <= result.keys()
    assert not {"agent", "grasp_rate", "time_to_grasp_mean", "dropped_rate"} & result.keys()
    who = tuple(result[name] for name in ("env", "preset", "controller", "episodes", "backend"))
    assert who == ("cobotta_follow_target", "static", "ik", 1, "mujoco")
    assert result["success_rate"] == 1 and result["position_error_mean"] < 5e-3 and result["warning"] == ""


@pytest.mark.slow
def test_ik_does_not_move_towards_what_is_out_of_reach(call, tmp_path):
    _, err, result = followed(call, tmp_path, 1.0)
    text = "inverse kinematics found no solution in 150 of 150 steps (1 of 1 episodes): the arm did not move there"
    assert err == f"warning: {text}\n" and result["warning"] == text
    start = np.linalg.norm(HOME - [1.0, 0.0, 0.5])
    assert result["success_rate"] == 0
    assert result["settled_error_max"] == pytest.approx(start, abs=1e-3)
    assert result["settled_error_mean"] == pytest.approx(start, abs=1e-3)


def test_rmpflow_arrives(play):
    result = play("cobotta_follow_target", "static", "rmpflow", episode_length_s=6.0, **at(0.5, 0.0, 0.5))
    assert result["controller"] == "rmpflow" and result["warning"] == ""
    assert result["success_rate"] == 1 and result["position_error_mean"] < 5e-3


@pytest.mark.slow
def test_rmpflow_comes_as_near_as_the_arm_reaches(play):
    """Far away the arm stretches out: 0.51 + 0.39 + 0.16 m from the shoulder, 0.12 m to its side."""
    nearest = np.hypot(np.sqrt(2.0**2 - 0.12**2), 0.5 - 0.21) - 1.06
    result = play("cobotta_follow_target", "static", "rmpflow", episode_length_s=6.0, **at(2.0, 0.0, 0.5))
    assert result["success_rate"] == 0
    assert nearest - 1e-3 < result["position_error_mean"] < nearest + 0.03


@pytest.mark.slow
@pytest.mark.parametrize("controller", ["ik", "rmpflow"])
def test_moving_target_is_tracked(play, controller):
    """Round a circle of 0.1 m in four seconds: after half of the episode never further than 2 cm away."""
    result = play("cobotta_follow_target", "default", controller, episodes=4)
    assert result["success_rate"] == 1 and result["warning"] == ""
    assert result["settled_error_max"] < 0.02


@pytest.mark.slow
def test_nero_follows(play):
    result = play("nero_follow_target", "static", episodes=8)
    assert result["controller"] == "rmpflow"  # the task's first
    assert result["success_rate"] == 1 and result["settled_error_max"] < 5e-3


# --- pick and place


def test_cobotta_picks_and_places(play):
    result = play("cobotta_pick_place", episodes=16)
    assert result["controller"] == "pick_place" and result["warning"] == ""
    assert result["success_rate"] == 1 and result["grasp_rate"] == 1 and result["dropped_rate"] == 0
    assert result["position_error_mean"] < 5e-3
    assert result["nan_count"] == result["overflow_count"] == 0


@pytest.mark.slow
def test_cobotta_reaches_round_to_the_tutorials_goal(play):
    result = play("cobotta_pick_place", episodes=16, **at(-0.3, 0.6, 0.02575))
    assert result["success_rate"] == 1 and result["position_error_mean"] < 5e-3


@pytest.mark.slow
def test_nero_picks_and_places(play):
    result = play("nero_pick_place", controller="expert", episodes=8)
    assert result["controller"] == "pick_place"
    assert result["success_rate"] == 1 and result["position_error_mean"] < 5e-3


# --- mistakes

FOLLOW = ["--env", "cobotta_follow_target"]


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (
            [*FOLLOW, "--controller", "pick_place"],
            "'pick_place' cannot play cobotta_follow_target: choose one of policy, expert, rmpflow, ik",
        ),
        (
            ["--env", "cobotta_pick_place", "--controller", "ik"],
            "'ik' cannot play cobotta_pick_place: choose one of policy, expert, pick_place",
        ),
        (["--env", "cobotta_push", "--controller", "ik"], "'ik' cannot play cobotta_push: choose policy, it has no expert"),
        (["--env", "cobotta_push", "--agent", "expert"], "'expert' cannot play cobotta_push: choose policy, it has no expert"),
        ([*FOLLOW, "--controller", "ik", "--policy", "p.safetensors"], "pass --controller, --agent or --policy"),
        ([*FOLLOW, "--controller", "ik", "--agent", "zero"], "pass --controller, --agent or --policy"),
        ([*FOLLOW, "--agent", "zero", "--control.restarts", "3"], "--control.* needs --agent with a controller's name"),
        (["--env", "cobotta_lift", "--control.restarts", "3"], "--control.* needs --agent with a controller's name"),
        ([*FOLLOW, "--controller", "ik", "--control.restart", "3"], "no field 'restart'"),
        ([*FOLLOW, "--controller", "rmpflow", "--control.descriptor", "nowhere.yaml"], "nowhere.yaml"),
        (
            [*FOLLOW, "--controller", "spline"],
            "'spline' cannot play cobotta_follow_target: choose one of policy, expert, rmpflow, ik",
        ),
        (["--env", "cobotta_pick_place", "--control.events_dt", "(1, 1)"], "events_dt takes 10 shares above 0 and up to 1"),
    ],
    ids=lambda x: " ".join(x) if isinstance(x, list) else "",
)
def test_a_mistake_is_one_line(call, argv, message):
    code, out, err = call("eval", *argv)
    assert (code, out) == (2, "")
    assert err.startswith("error: ") and err.count("\n") == 1
    assert message in err


@pytest.mark.parametrize(("env", "name"), [("cobotta_follow_target", "ik"), ("follow_target", "expert")])
def test_help_lists_the_controllers_fields(call, env, name):
    code, out, _ = call("eval", "--help", "--env", env, "--robot", "cobotta_pro_900", "--controller", name)
    assert code == 0 and "--control.position_tolerance 0.001" in out and "--env.command.motion.params.radius " in out


def test_zero_agent_stays_home_where_actions_are_targets(call, tmp_path):
    argv = ["--preset", "static", "--agent", "zero", "--episodes", 2, "--env.episode_length_s", 1, "--json", "result.json"]
    code, _, _ = call("eval", *FOLLOW, *argv, *(f"--env.{name}={value}" for name, value in at(0.5, 0.0, 0.5).items()))
    result = json.loads((tmp_path / "result.json").read_text())
    assert code == 0 and result["agent"] == "zero" and "controller" not in result and "warning" not in result
    assert result["final_distance_mean"] == pytest.approx(0.04, abs=1e-3)
