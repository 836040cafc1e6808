"""The notebooks run from top to bottom and show what they say."""

import math
import os
import pathlib
import re

import jax
import nbclient
import nbformat
import pytest

import mjx_nero
from mjx_nero.sim import render

ROOT = pathlib.Path(__file__).parents[1]
NAMES = ("01_nero_lift", "02_cobotta_motion", "03_bring_your_own_arm", "04_onto_the_arm", "05_what_it_sees")
NOTEBOOKS = tuple(ROOT / "notebooks" / f"{name}.ipynb" for name in NAMES)
NERO_LIFT, COBOTTA_MOTION, OWN_ARM, ONTO_ARM, SEES = NOTEBOOKS
STEPS = 6_144  # 4 iterations of PPO with the first notebook's 64 environments
ARM_STEPS = 122_880  # 40 with the third's 128: every reach succeeds
# Run first in each kernel. It fails if the number has another name, because 2,000 steps of cloning take half a minute of a core.
SHORT = "import pytest; pytest.MonkeyPatch().setattr('mjx_nero.learn.ppo.imitation.PASSES', 1.25)"


def _run(path: pathlib.Path, folder: pathlib.Path, steps: int = STEPS) -> list:
    """All outputs of one run, on the CPU, whose kernel shares the tests' compilation cache and clones no longer than they do."""
    notebook = nbformat.read(path, as_version=4)
    notebook.cells.insert(0, nbformat.v4.new_code_cell(SHORT))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MJX_NERO_NOTEBOOK_STEPS", str(steps))
        patch.setenv("MJX_NERO_NOTEBOOK_EPISODES", "3")
        patch.setenv("MJX_NERO_NOTEBOOK_SECONDS", "12")
        patch.setenv("JAX_COMPILATION_CACHE_DIR", str(jax.config.jax_compilation_cache_dir))
        patch.setenv("JAX_PLATFORMS", "cpu")
        patch.setenv("PYTHONPATH", os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH")))))
        patch.setenv("TMPDIR", str(folder))  # where the notebook's training run goes
        client = nbclient.NotebookClient(notebook, timeout=600, kernel_name="python3", resources={"metadata": {"path": folder}})
        client.execute()  # raises at the first cell that fails
    return [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]


@pytest.fixture(scope="module")
def outputs(tmp_path_factory) -> list:
    return _run(NERO_LIFT, tmp_path_factory.mktemp("nero_lift"))


@pytest.fixture(scope="module")
def motion_outputs(tmp_path_factory) -> list:
    return _run(COBOTTA_MOTION, tmp_path_factory.mktemp("cobotta_motion"))


@pytest.fixture(scope="module")
def arm_outputs(tmp_path_factory) -> list:
    return _run(OWN_ARM, tmp_path_factory.mktemp("own_arm"), ARM_STEPS)


def _text(outputs: list) -> str:
    return "".join(output.text for output in outputs if output.output_type == "stream")


def _figure(pattern: str, text: str) -> float:
    found = re.search(pattern, text)
    assert found, f"{pattern!r} is not in the notebook's output:\n{text}"
    return float(found[1].replace(",", ""))


def _can_draw() -> bool:
    try:
        with render.Renderer(mjx_nero.make("nero_lift", impl="native").mj_model):
            return True
    except mjx_nero.UserError:
        return False


PICTURES = {
    NERO_LIFT: (3, 2),
    COBOTTA_MOTION: (5, 3),
    OWN_ARM: (3, 2),
    ONTO_ARM: (2, 0),
    SEES: (2, 3),
}  # plotted always, drawn where the machine can draw


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_ships_with_its_outputs_and_nothing_of_the_machine_that_made_them(path):
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    outputs = [output for cell in code for output in cell.outputs]
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1))  # run from top to bottom
    assert sum("image/png" in output.get("data", {}) for output in outputs) == sum(PICTURES[path])
    assert {output.output_type for output in outputs} <= {"stream", "display_data", "execute_result"}
    assert {output.name for output in outputs if output.output_type == "stream"} == {"stdout"}  # no warnings
    assert not re.search(r"/(tmp|home|root|usr|work)/|steps/s|call, with|Traceback", _text(outputs))
    assert path.stat().st_size < 500_000


def _check(outputs: list, path: pathlib.Path) -> None:
    """No errors, and every picture."""
    plotted, drawn = PICTURES[path]
    assert not [output for output in outputs if output.output_type == "error"]
    assert "Traceback" not in _text(outputs)
    pictures = [output.data["image/png"] for output in outputs if "image/png" in output.get("data", {})]
    assert len(pictures) == len(set(pictures)) == plotted + (drawn if _can_draw() else 0)


def test_nero_lift_runs_and_shows_every_picture(outputs):
    _check(outputs, NERO_LIFT)  # reward terms, changed config, learning curve; home pose, strip


@pytest.mark.slow
def test_cobotta_motion_runs_and_shows_every_picture(motion_outputs):
    _check(motion_outputs, COBOTTA_MOTION)  # gripper, errors, RMPflow, following, phases; robot, two strips


@pytest.mark.slow
def test_gripper_and_kinematics_of_the_notebook(motion_outputs):
    text = _text(motion_outputs)
    assert abs(_figure(r"gap between the pads: (-?[\d.]+) to", text)) < 1
    assert _figure(r"gap between the pads: -?[\d.]+ to ([\d.]+) mm", text) == pytest.approx(151.4, abs=1)
    assert "solved: True" in text
    assert _figure(r"success rate over 1000 poses: ([\d.]+)", text) >= 0.99


@pytest.mark.slow
def test_rmpflow_goes_round_the_ball_in_the_notebook(motion_outputs):
    text = _text(motion_outputs)
    for path in ("free", "with a ball"):
        assert _figure(rf"{path}: at the end ([\d.]+) mm", text) < 1
    assert _figure(r"free: .* least clearance (-?\d+) mm", text) < 0 < _figure(r"ball: .* least clearance (-?\d+) mm", text)


@pytest.mark.slow
def test_controllers_do_their_tasks_in_the_notebook(motion_outputs):
    text = _text(motion_outputs)
    for name in ("ik", "rmpflow"):
        assert _figure(rf"{name}: ([\d.]+) mm from the target in the second half", text) < 20  # the task's threshold
    assert _figure(r"success rate over 4 episodes: ([\d.]+)", text) == 1
    assert _figure(r"from the goal at the end: ([\d.]+) mm", text) < 10
    assert _figure(r"([\d,]+) control steps/s", text) > 100


def test_bundled_policy_succeeds_in_the_notebook(outputs):
    assert _figure(r"success rate over 64 episodes: ([\d.]+)", _text(outputs)) >= 0.9


def test_reward_terms_tell_the_policy_from_no_action(outputs):
    text = _text(outputs)
    idle = _figure(r"return, no action: (-?[\d.]+)", text)
    assert _figure(r"return, the bundled policy: (-?[\d.]+)", text) > 10 * max(idle, 1.0)


def test_changed_config_changes_the_reward(outputs):
    text = _text(outputs)
    before = _figure(r"sum over the episode: (-?[\d.]+) ->", text)
    assert _figure(r"sum over the episode: -?[\d.]+ -> (-?[\d.]+)", text) != pytest.approx(before, rel=0.05)
    assert "did you mean 'reaching_object'" in text


def test_notebook_trains_its_budget(outputs):
    text = _text(outputs)
    assert _figure(r"([\d,]+) env-steps/s", text) > 0
    assert _figure(r"([\d,]+) env steps, success", text) == STEPS


@pytest.mark.slow
def test_own_arm_runs_and_shows_every_picture(arm_outputs):
    _check(arm_outputs, OWN_ARM)  # step responses, learning curve, distances; home pose, strip


@pytest.mark.slow
def test_import_of_the_notebook_keeps_the_urdf_and_reports_its_flaw(arm_outputs):
    text = _text(arm_outputs)
    mass = 1.5 + 0.7 + 0.6 + 0.4 + 0.25 + 0.2 + 0.03 + 0.03  # of the links in the notebook [kg]
    assert _figure(r"mass: ([\d.]+) kg", text) == pytest.approx(mass, abs=1e-3)
    assert _figure(r"in the URDF ([\d.]+) kg", text) == pytest.approx(mass, abs=1e-3)
    assert "arm: waist, lift, elbow, pitch, roll  gripper: left_slide\n" in text
    assert "left_finger, limits [0.0, 0.035]\n" in text and "right_finger, limits [0.0, 0.035] follows left_slide" in text
    assert re.findall(r"^(?:repaired|warning): (\S+ \S+):", text, re.MULTILINE) == ["link forearm", "joint left_slide"]
    assert "the inertia was zero" in text and "effort 30 is more than fingers take: now" in text
    assert _figure(r"100 poses: at most ([\d.]+) micrometres", text) < 1
    # The grasp point at home, by hand: pitched by 0.2, 1.7 and 3.1 rad, it hangs from an arm of 0.24, 0.2 and 0.06 + 0.093 m.
    x = 0.24 * math.sin(0.2) + 0.2 * math.sin(1.7) + 0.153 * math.sin(3.1)
    z = 0.15 + 0.24 * math.cos(0.2) + 0.2 * math.cos(1.7) + 0.153 * math.cos(3.1)
    assert _figure(r" ee +([\d.]+) +0\.000", text) == pytest.approx(x, abs=2e-3)
    assert _figure(r" ee +[\d.]+ +0\.000 +([\d.]+)", text) == pytest.approx(z, abs=2e-3)


@pytest.mark.slow
def test_collision_shapes_of_the_notebook_cover_the_parts(arm_outputs):
    covered = re.findall(r"covers (\d+)% of the surface", _text(arm_outputs))
    assert len(covered) >= 7 and min(map(int, covered)) >= 95


@pytest.mark.slow
def test_joints_of_the_notebook_reach_their_limits_and_are_tuned(arm_outputs):
    text = _text(arm_outputs)
    assert "movements that arrive: 12 of 12" in text  # both ends of five joints, and the finger
    assert _figure(r"largest overshoot: ([\d.]+)%", text) < 2 and _figure(r"largest overshoot: .* -> ([\d.]+)%", text) < 2
    settled = _figure(r"slowest to settle: ([\d.]+) s", text)
    assert _figure(r"slowest to settle: .* -> ([\d.]+) s", text) < settled
    assert "guessed gains left: 0\n" in text


@pytest.mark.slow
def test_arm_of_the_notebook_learns_to_reach(arm_outputs):
    text = _text(arm_outputs)
    assert _figure(r"([\d,]+) env steps, success", text) == ARM_STEPS
    assert _figure(r"no action: success rate ([\d.]+)", text) < 0.05
    assert _figure(r"the policy: success rate ([\d.]+)", text) > 0.8
    idle = _figure(r"no action: .* at the end ([\d.]+) cm", text)
    assert _figure(r"the policy: .* at the end ([\d.]+) cm", text) < idle / 3


@pytest.fixture(scope="module")
def onto_outputs(tmp_path_factory) -> list:
    return _run(ONTO_ARM, tmp_path_factory.mktemp("onto_arm"))


@pytest.mark.slow
def test_onto_the_arm_finds_the_delay_and_succeeds(onto_outputs):
    _check(onto_outputs, ONTO_ARM)  # measured and predicted, success
    text = _text(onto_outputs)
    assert _figure(r"delay found: (\d+) ms", text) == pytest.approx(40, abs=2)
    assert _figure(r"identified: off by ([\d.]+) mrad", text) < 1
    assert _figure(r"softer and late drives: (\d+)%", text) < 50 < _figure(r"that was found: (\d+)%", text)


@pytest.mark.slow
@pytest.mark.skipif(not _can_draw(), reason="no offscreen OpenGL here")
def test_the_policy_of_the_notebook_sees_and_goes_blind(tmp_path):
    outputs = _run(SEES, tmp_path)
    _check(outputs, SEES)  # how far it is off, what makes it blind; first pictures, where it looks, the worst seen
    text = _text(outputs)
    assert _figure(r"success rate over 3 episodes: ([\d.]+)", text) > 0.5
    assert _figure(r"cube seen off by: (\d+) mm at the start", text) < 40
    near = _figure(r"light .* 1: (\d+) mm", text)
    assert _figure(r"light \[factor\]: 0.1: (\d+) mm", text) > 1.5 * near
