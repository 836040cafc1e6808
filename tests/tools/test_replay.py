"""A logged run beside the simulation's prediction: errors, and what the page shows."""

import contextlib
import dataclasses
import types

import mujoco
import numpy as np
import pytest

from mjx_nero.errors import UserError
from mjx_nero.identify import RecordCfg, log, record
from mjx_nero.identify.plant import Plant
from mjx_nero.sim import scene
from mjx_nero.tasks import registry
from mjx_nero.tools import replay

ROBOT = registry.robot("so_arm101")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Six seconds of an arm with the model's drives whose targets are 60 ms late."""
    plant, path = Plant(ROBOT, 0.005), tmp_path_factory.mktemp("replay") / "log.csv"
    made, truth = record(plant, RecordCfg(seconds=6.0, noise=0.0, resolution=0.0, scatter=1.0, delay=0.06))
    log.write(path, made, ROBOT.arm.joints)
    return path, truth


def drives(path, delay, robot="so_arm101"):
    rows = "\n".join(f"  {name}: {{offset: {{value: 0, low: 0, high: 0}}}}" for name in ROBOT.arm.joints)
    path.write_text(f"robot: {robot}\ndelay: {{value: {delay}, low: 0, high: 1}}\njoints:\n{rows}\n")
    return path


def test_the_delay_explains_what_the_model_does_not(recorded, tmp_path):
    path, truth = recorded
    before = replay.run_of(path, ROBOT, 0.005).errors()
    after = replay.run_of(path, ROBOT, 0.005, drives(tmp_path / "d.yaml", truth.delay)).errors()
    assert (before > 0.005).all() and (after < before / 20).all()


def test_another_robots_file_is_refused(recorded, tmp_path):
    with pytest.raises(UserError, match="is for nero"):
        replay.run_of(recorded[0], ROBOT, 0.005, drives(tmp_path / "d.yaml", 0.0, "nero"))


ANOTHERS = {
    "named": ("# robot: nero\n", "", "is a log of 'nero', but the robot is so_arm101"),
    "more joints": ("", ",position.joint7", "has columns of 'joint7', which so_arm101 lacks"),
}


@pytest.mark.parametrize("case", ANOTHERS)
@pytest.mark.parametrize("command", ["replay LOG --no-view --robot so_arm101", "identify LOG --robot so_arm101", "demos"])
def test_another_robots_log_is_refused(call, tmp_path, command, case):
    """By its comment, or by its columns: a Nero's log also has all columns of a Piper's."""
    note, column, said = ANOTHERS[case]
    wanted = ["time", "inferred", *(f"{what}.{j}" for what in ("target", "position") for j in ROBOT.joints)]
    (tmp_path / "log.csv").write_text(f"{note}{','.join(wanted)}{column}\n")
    command = command.replace("LOG", "log.csv")
    if command == "demos":
        command = "demos --env so101_reach --form arrays --out made --log log.csv"
    code, _, err = call("mjx_nero", *command.split())
    assert code == 2 and said in err and err.count("\n") == 1 and not (tmp_path / "made").exists()


class Server:
    """Keeps what a ``viser.ViserServer`` is told to show."""

    def __init__(self):
        self.shown, self.initial_camera, self.scene, self.gui = {}, types.SimpleNamespace(), self, self

    def set_up_direction(self, _):
        pass

    def add_mesh_simple(self, name, vertices, faces, color, opacity):
        self.shown[name] = types.SimpleNamespace(opacity=opacity, position=None, wxyz=None)
        return self.shown[name]

    def add_label(self, name, text, position):
        self.shown[text] = position

    def add_slider(self, label, low, high, step, start):
        return types.SimpleNamespace(value=start)

    def add_checkbox(self, label, value):
        return types.SimpleNamespace(value=value)

    def atomic(self):
        return contextlib.nullcontext()


def test_both_arms_are_where_they_were(recorded):
    run = replay.run_of(recorded[0], ROBOT, 0.005)
    run = dataclasses.replace(run, predicted=run.measured + 0.1)
    model, server = scene.robot_model(ROBOT, whole=True), Server()
    picture = replay.Picture(server, model, ROBOT, run)
    picture.playing.value = False
    picture.slider.value = 3.0
    picture.step()
    k = int(np.searchsorted(run.times, 3.0))
    data, at = mujoco.MjData(model), [int(model.joint(j).qposadr[0]) for j in ROBOT.arm.joints]
    for which, positions, aside in (("measured", run.measured, 0.0), ("predicted", run.predicted, replay._APART)):
        data.qpos[:] = model.qpos0
        data.qpos[at] = positions[k]
        mujoco.mj_kinematics(model, data)
        name = next(n for n in server.shown if n.startswith(f"/{which}/") and n.split("/")[2] == model.body(3).name)
        np.testing.assert_allclose(server.shown[name].position, data.xpos[3] + [0, aside, 0], atol=1e-9)
        assert (server.shown[name].opacity is None) == (which == "measured")
    picture.playing.value = True
    picture.step()
    assert picture.slider.value == pytest.approx(3.04)


def test_the_table_says_how_far_they_differ(call, recorded):
    status, out, err = call("mjx_nero", "replay", str(recorded[0]), "--robot", "so_arm101", "--no-view")
    assert (status, err) == (0, "") and "predicted minus measured" in out and "shoulder_pan" in out
