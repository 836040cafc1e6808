"""What is varied to see how far a policy gets."""

import dataclasses
import json

import jax
import matplotlib
import pytest

from mjx_nero import UserError, __main__
from mjx_nero.tasks.registry import env_cfg
from mjx_nero.tools.robustness import command, measure, seen
from mjx_nero.tools.robustness.sweeps import ALL, Point, sweeps


def test_a_lift_has_its_object_and_a_reach_only_its_arm():
    lift, reach = sweeps(env_cfg("nero_lift")), sweeps(env_cfg("nero_reach"))
    assert "object mass [factor]" in lift and "gravity compensation [factor]" not in lift  # Nero's drives do not compensate
    assert set(reach) < set(lift) and not {name for name in reach if "object" in name or "pads" in name}
    assert "gravity compensation [factor]" in sweeps(env_cfg("piper_lift"))


def test_one_parameter_differs_at_a_time_and_the_others_stay():
    value, point = sweeps(env_cfg("nero_lift"))["damping [factor]"][0]
    (term,) = point.terms.values()
    assert value == 0.5 and term.params["damping"] == (0.5, 0.5)
    assert term.params["stiffness"] == term.params["effort"] == (1.0, 1.0) and term.params["actuators"][0] == "joint1"
    assert point.delay == (0, 0) and point.offset == 0.0
    steps, late = sweeps(env_cfg("nero_lift"))["action delay [control steps]"][3]
    assert steps == 3 and late.delay == (3, 3) and not late.terms


def test_all_at_once_widens_the_presets_ranges():
    (zero, none), _, (one, preset), (more, wide) = sweeps(env_cfg("nero_lift"))[ALL]
    assert (zero, one, more) == (0.0, 1.0, 1.5) and not none.terms and preset.delay == (0, 3) and wide.delay == (0, 4)
    assert preset.terms["cube_mass"].params["scale"] == (0.5, 4.0) and wide.terms["cube_mass"].params["scale"] == (0.25, 5.5)
    assert wide.terms["link_center"].params["offset"] == pytest.approx(0.015)


def test_an_unknown_parameter_is_one_line():
    with pytest.raises(UserError, match="no parameter has gravty in its name"):
        __main__.main(["robustness", "--env", "nero_lift", "--only", "gravty"])


def test_actions_are_as_late_as_asked_for_whatever_the_task_draws():
    """Five control steps undo what a policy learnt that knows none or one."""
    bench = measure.Bench("nero_reach", "default", env_cfg("nero_reach"), None, 32, "native", 1)
    rates = {late: bench.success(Point(delay=(late, late)))["success_rate"] for late in (0, 5)}
    assert rates[0] > 0.9 and rates[5] < rates[0] - 0.3


def test_a_task_with_cameras_has_what_it_sees():
    """One property at a time; nothing at the value where all is as it is; the whole look's ranges about what the model has."""
    found, plain = sweeps(env_cfg("nero_lift", "rgb")), sweeps(env_cfg("nero_lift"))
    own = set(found) - set(plain)
    assert {name.split()[0] for name in own} == {"light", "camera", "colour", "patterns", "distractors", "pictures", "whole"}
    assert "objects seen off by [m]" in plain and "objects seen off by [m]" not in found
    for name in own:
        neutral = [point for value, point in found[name] if value == ("factor" in name)]
        assert neutral == [Point()], name
    light = dict(found["light [factor]"])[0.5].look.terms
    assert light["lights"].params == {"turn": 0.0, "brightness": (0.5, 0.5), "tint": 0.0, "dark": 0.0}
    (moved,) = dict(found["camera moved by [m]"])[0.1].look.terms.values()
    assert moved.params == {"cameras": ("front",), "offset": 0.1, "turn": 0.0}
    whole = dict(found["whole look [width]"])
    one, wide = whole[1.0].look.terms, whole[1.5].look.terms
    look = env_cfg("nero_lift", "rgb").look
    assert one["lights"].params["brightness"] == pytest.approx((0.4, 1.4)) and one["props_left"].params["there"] == 0.6
    assert wide["lights"].params["brightness"] == pytest.approx((0.1, 1.6)) and wide["table"].params["change"] == 1.0
    assert (
        wide["front_pose"].params["offset"] == pytest.approx(0.03)
        and wide["props_left"].params["x"] == look["props_left"].params["x"]
    )


@pytest.mark.slow
def test_the_dark_is_seen(monkeypatch):
    """A policy that sees is measured in two looks from the same starts: without light its pictures are darker, and it fails."""
    cfg = dataclasses.replace(env_cfg("nero_lift", "rgb"), episode_length_s=3.0)
    bench = measure.Bench("nero_lift", "rgb", cfg, None, 4, "native", 1)
    points = dict(sweeps(cfg)["light [factor]"])
    dark = dataclasses.replace(points[0.2].look.terms["lights"], params={"turn": 0.0, "brightness": (0.01, 0.01), "tint": 0.0})
    begun = jax.jit(jax.vmap(bench.env.reset))(jax.random.split(jax.random.PRNGKey(0), 4))
    states = [
        jax.jit(bench._start)(bench._given(point), begun)
        for point in (
            points[1.0],
            Point(look=seen.Look({"lights": dark})),
            dict(sweeps(cfg)["pictures late [control steps]"])[3.0],
        )
    ]
    lit, unlit, late = (state.obs["pictures"]["front"].astype(float) for state in states)
    assert unlit.mean() < 0.8 * lit.mean() and (late == lit).all()
    lags = [state.info["carry"].memory["sensors.lens_front"][4]["rgb"].lag.tolist() for state in states]
    assert lags == [[0] * 4, [0] * 4, [3] * 4]
    assert bench.success(points[1.0])["success_rate"] > 0.5
    monkeypatch.setattr(bench, "_run", None)  # what was played is not played again
    assert bench.success(Point())["success_rate"] > 0.5


FIGURES = {
    "env": "nero_lift",
    "preset": "default",
    "version": "0.5.0",
    "curves": {"damping [factor]": [{"value": 0.5, "success_rate": 0.25, "success_rate_95": [0.1, 0.4], "diverged": 0}]},
}


def test_two_policies_are_in_one_picture(tmp_path):
    path = tmp_path / "plain.json"
    path.write_text(json.dumps(FIGURES))
    plain = command.read(path)
    assert plain["curves"]["damping [factor]"] == [{"value": 0.5, "success_rate": 0.25, "success_rate_95": (0.1, 0.4)}]
    sizes = []
    for name, results in (("one", [plain]), ("two", [plain, {**plain, "preset": "sim2real"}])):
        command.save_plot(tmp_path / f"{name}.png", results)
        sizes.append((tmp_path / f"{name}.png").stat().st_size)
    assert sizes[1] > sizes[0] > 1000  # a legend and a second line


def test_two_policies_of_one_preset_have_their_own_names(tmp_path):
    path = tmp_path / "two.svg"
    plain = {**FIGURES, "policy": None}
    with matplotlib.rc_context({"svg.fonttype": "none"}):
        command.save_plot(path, [plain, {**plain, "policy": "mine.safetensors"}])
    assert "bundled policy" in path.read_text() and "mine.safetensors" in path.read_text()


def test_results_of_another_environment_are_refused(call, tmp_path):
    (tmp_path / "lift.json").write_text(json.dumps(FIGURES))
    code, _, err = call("mjx_nero", *"robustness --env nero_reach --plot p.png --beside lift.json".split())
    assert code == 2 and "lift.json holds results of nero_lift, and this is nero_reach" in err


@pytest.mark.parametrize(
    "content",
    [
        "{",
        "[]",
        "{}",
        "null",
        json.dumps({**FIGURES, "curves": {"a": [{"value": "x"}]}}),
        json.dumps({**FIGURES, "curves": {"a": [{"value": 1, "success_rate": 1, "success_rate_95": [1]}]}}),
        "[" * 100_000,
    ],
)
def test_what_holds_no_figures_is_one_line(tmp_path, content):
    path = tmp_path / "other.json"
    path.write_text(content)
    with pytest.raises(
        UserError, match=r"other\.json (holds no results of robustness: give a file written with --json|is not JSON: )"
    ):
        command.read(path)
    with pytest.raises(UserError, match="--beside adds curves to the plot: pass --plot, too"):
        __main__.main(["robustness", "--env", "nero_lift", "--beside", str(path)])
