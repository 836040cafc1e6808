"""The notebook runs from top to bottom and shows what it says."""

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
NOTEBOOK = ROOT / "notebooks" / "01_nero_lift.ipynb"
STEPS = 12_288  # 8 iterations of PPO with the notebook's 64 environments
PICTURES = {"drawn": 2, "plotted": 3}  # home pose and strip; reward terms, changed config and learning curve


@pytest.fixture(scope="module")
def outputs(tmp_path_factory) -> list:
    """All outputs of one run, on the CPU, whose kernel shares the tests' compilation cache."""
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    folder = tmp_path_factory.mktemp("notebook")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MJX_NERO_NOTEBOOK_STEPS", str(STEPS))
        patch.setenv("JAX_COMPILATION_CACHE_DIR", str(jax.config.jax_compilation_cache_dir))
        patch.setenv("JAX_PLATFORMS", "cpu")
        patch.setenv("PYTHONPATH", os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH")))))
        patch.setenv("TMPDIR", str(folder))  # where the notebook's training run goes
        client = nbclient.NotebookClient(notebook, timeout=600, kernel_name="python3", resources={"metadata": {"path": folder}})
        client.execute()  # raises at the first cell that fails
    return [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]


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


def test_notebook_ships_without_outputs():
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    nbformat.validate(notebook)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert all(not cell.outputs and cell.execution_count is None for cell in code)


def test_notebook_runs_without_errors(outputs):
    assert not [output for output in outputs if output.output_type == "error"]
    assert "Traceback" not in _text(outputs)


def test_notebook_shows_every_picture(outputs):
    pictures = [output.data["image/png"] for output in outputs if "image/png" in output.get("data", {})]
    expected = PICTURES["plotted"] + (PICTURES["drawn"] if _can_draw() else 0)
    assert len(pictures) == expected
    assert len(set(pictures)) == expected


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
