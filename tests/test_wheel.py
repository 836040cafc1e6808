"""The wheel holds all that the package needs: types, assets and policies; installed, it trains."""

import json
import os
import pathlib
import subprocess
import sys
import zipfile

import pytest

ROOT = pathlib.Path(__file__).parents[1]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> pathlib.Path:
    folder = tmp_path_factory.mktemp("dist")
    build = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(folder), str(ROOT)]
    subprocess.run(build, check=True, capture_output=True)
    (found,) = folder.glob("*.whl")
    return found


@pytest.mark.slow
def test_a_wheel_has_types_assets_and_policies(wheel):
    names = set(zipfile.ZipFile(wheel).namelist())
    assert {"mjx_nero/py.typed", "mjx_nero/assets/nero/nero.xml", "mjx_nero/assets/policies/nero_lift.safetensors"} <= names
    (metadata,) = [zipfile.ZipFile(wheel).read(name).decode() for name in names if name.endswith("METADATA")]
    needed = [line for line in metadata.splitlines() if line.startswith("Requires-Dist: scipy")]
    assert needed and "extra ==" not in needed[0]


@pytest.fixture(scope="module")
def run(wheel, tmp_path_factory):
    """``run(code, *argv)``: a program of its own where the wheel is installed, in an empty folder."""
    folder = tmp_path_factory.mktemp("installed")
    zipfile.ZipFile(wheel).extractall(folder / "site")  # what an installer does with a wheel of pure Python
    (folder / "work").mkdir()

    def run(code, *argv, **env):
        env = {**os.environ, "PYTHONPATH": str(folder / "site"), **env}
        return subprocess.run([sys.executable, "-c", code, *argv], cwd=folder / "work", env=env, capture_output=True, text=True)

    return run


PROGRAM = "import mjx_nero, sys; from mjx_nero.__main__ import main, program; print(mjx_nero.__file__); {}program()"
VIEWER = "import mjx_nero.tools.view.opening, mjx_nero.tools.view.session; sys.modules['viser'] = None; "


@pytest.mark.slow
def test_a_wheel_trains(run):
    sizes = ["--impl", "native", "--num-envs", "64", "--num-timesteps", "1536", "--no-video"]
    found = run(PROGRAM.format(""), "train", "--env", "nero_reach", *sizes, "--out", "run")
    assert found.returncode == 0, found.stderr
    package = pathlib.Path(found.stdout.splitlines()[0]).parent
    assert package.parent.name == "site"
    folder = package.parents[1] / "work" / "run"
    assert (folder / "policy.safetensors").is_file()
    assert json.loads((folder / "summary.json").read_text())["env_steps"] >= 1536


@pytest.mark.slow
def test_a_wheel_inspects_plays_and_views(run):
    """``mjx-nero`` is the program of the entry point; the viewer says in a line if its extra is lacking."""
    found = run(PROGRAM.format("main(['inspect', 'nero']); "), "eval", "--env", "nero_reach", "--episodes", "4")
    assert found.returncode == 0 and "joints of nero" in found.stdout and "success rate" in found.stdout, found.stderr
    found = run(PROGRAM.format(VIEWER), "view", "--env", "nero_reach")
    assert found.returncode == 2 and "/site/mjx_nero/" in found.stdout
    assert found.stderr == "error: this needs viser, of the extra 'view': pip install 'mjx-nero[view]'\n"
