"""The notebooks run from top to bottom and show what they say."""

import os
import pathlib
import re

import jax
import nbclient
import nbformat
import pytest

import mjx_nero
from mjx_nero import render

ROOT = pathlib.Path(__file__).parents[1]
NERO_LIFT, COBOTTA_MOTION = (ROOT / "notebooks" / f"{name}.ipynb" for name in ("01_nero_lift", "02_cobotta_motion"))
STEPS = 12_288  # 8 iterations of PPO with the first notebook's 64 environments


def _run(path: pathlib.Path, folder: pathlib.Path) -> list:
    """All outputs of one run, on the CPU, whose kernel shares the tests' compilation cache."""
    notebook = nbformat.read(path, as_version=4)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MJX_NERO_NOTEBOOK_STEPS", str(STEPS))
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


def _text(outputs: list) -> str:
    return "".join(output.text for output in outputs if output.output_type == "stream")


def _figure(pattern: str, text: str) -> float:
    found = re.search(pattern, text)
    assert found, f"{pattern!r} is not in the notebook's output:\n{text}"
    return float(found[1].replace(",", ""))


def _can_draw() -> bool:
    try:
        with render.Renderer(mjx_nero.make("nero_lift", impl="jax").mj_model):
            return True
    except mjx_nero.UserError:
        return False


@pytest.mark.parametrize("path", [NERO_LIFT, COBOTTA_MOTION], ids=lambda path: path.stem)
def test_notebook_ships_without_outputs(path):
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert all(not cell.outputs and cell.execution_count is None for cell in code)


def _check(outputs: list, plotted: int, drawn: int) -> None:
    """No errors, and every picture: ``plotted`` ones always, ``drawn`` ones where the machine can draw."""
    assert not [output for output in outputs if output.output_type == "error"]
    assert "Traceback" not in _text(outputs)
    pictures = [output.data["image/png"] for output in outputs if "image/png" in output.get("data", {})]
    assert len(pictures) == len(set(pictures)) == plotted + (drawn if _can_draw() else 0)


def test_nero_lift_runs_and_shows_every_picture(outputs):
    _check(outputs, plotted=3, drawn=2)  # reward terms, changed config, learning curve; home pose, strip


@pytest.mark.slow
def test_cobotta_motion_runs_and_shows_every_picture(motion_outputs):
    _check(motion_outputs, plotted=5, drawn=3)  # gripper, errors, RMPflow, following, phases; robot, two strips


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


def test_shipped_policy_succeeds_in_the_notebook(outputs):
    assert _figure(r"success rate over 64 episodes: ([\d.]+)", _text(outputs)) >= 0.9


def test_reward_terms_tell_the_policy_from_no_action(outputs):
    text = _text(outputs)
    idle = _figure(r"return, no action: (-?[\d.]+)", text)
    assert _figure(r"return, the shipped policy: (-?[\d.]+)", text) > 10 * max(idle, 1.0)


def test_changed_config_changes_the_reward(outputs):
    text = _text(outputs)
    before = _figure(r"sum over the episode: (-?[\d.]+) ->", text)
    assert _figure(r"sum over the episode: -?[\d.]+ -> (-?[\d.]+)", text) != pytest.approx(before, rel=0.05)
    assert "did you mean 'reaching_object'" in text


def test_notebook_trains_its_budget(outputs):
    text = _text(outputs)
    assert _figure(r"([\d,]+) env-steps/s", text) > 0
    assert _figure(r"([\d,]+) env steps in \d+ s, success", text) == STEPS
