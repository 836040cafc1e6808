"""The command ``replay``: shows a logged run of an arm in a browser, beside the simulation's prediction for its targets."""

import dataclasses
import pathlib
import threading
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from mjx_nero.envs import identified
from mjx_nero.errors import UserError
from mjx_nero.identify import log as logs
from mjx_nero.identify.plant import Drives, Plant, usual_step
from mjx_nero.interop import need
from mjx_nero.runs.console import Table, screen
from mjx_nero.sim import scene
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.tasks import registry
from mjx_nero.tools import cli

_APART = 0.8  # distance between the two arms [m]
_RATE = 25.0  # pictures per second
_SHORTEST, _FEWEST = 1.0, 20  # minimum length of a log [s], and number of readings


@dataclasses.dataclass(frozen=True)
class Run:
    """An arm's run, and the simulation's prediction for its targets.

    Attributes:
        times: of the readings, from 0 on [s].
        measured, predicted: positions of the arm's joints [k, n] [rad or m].
    """

    times: np.ndarray
    measured: np.ndarray
    predicted: np.ndarray

    def errors(self) -> np.ndarray:
        """Returns the root mean square of predicted minus measured positions, by joint [n] [rad or m]."""
        return np.sqrt(np.mean((self.predicted - self.measured) ** 2, axis=0))


def run_of(path: pathlib.Path, robot: RobotCfg, dt: float, drives: pathlib.Path | None = None) -> Run:
    """Simulates a log's targets, starting from its first reading.

    Args:
        drives: file from ``identify``; None: the model's own drives.

    Raises:
        UserError: a file is missing, or from another robot.
    """
    plant = Plant(robot, dt)
    log = logs.read(path, robot.arm.joints, _SHORTEST, _FEWEST, robot)
    chosen = _drives(drives, robot, plant.nominal) if drives else plant.nominal
    (predicted,) = plant.readings([chosen], log.sent, log.targets, log.positions[0], log.times)
    return Run(log.times - log.times[0], log.positions, predicted)


def _drives(path: pathlib.Path, robot: RobotCfg, nominal: Drives) -> Drives:
    found = identified.read(path)
    if found.robot != robot.name or set(found.joints) != set(robot.arm.joints):
        raise UserError(f"{path} is for {found.robot} with joints {', '.join(found.joints)}, but the robot is {robot.name}")
    joints, known = [found.joints[name] for name in robot.arm.joints], {}
    for field in ("stiffness", "damping", "armature", "friction", "offset"):
        values = [getattr(joint, field) for joint in joints]
        known[field] = getattr(nominal, field) if None in values else np.array([value.value for value in values])
    return Drives(**known, delay=found.delay.value)


class Picture:
    """Two robots in a browser: the measured one, and beside it the predicted one, half transparent.

    Args:
        server: a ``viser.ViserServer``.
        model: with visual shapes.
    """

    def __init__(self, server: Any, model: mujoco.MjModel, robot: RobotCfg, run: Run):
        from mjx_nero.tools.view.scene import meshes

        self._server, self._model, self._data, self._run = server, model, mujoco.MjData(model), run
        self._at = [int(model.joint(name).qposadr[0]) for name in robot.arm.joints]
        server.scene.set_up_direction("+z")
        server.initial_camera.look_at = (0.2, _APART / 2, 0.2)
        server.initial_camera.position = (1.4, _APART / 2 - 0.9, 0.9)
        self._handles = []
        for which, opacity in enumerate((None, 0.5)):
            for body, name, mesh, rgba in meshes(model):
                if body:
                    color = tuple(int(255 * c) for c in rgba[:3])
                    path = f"/{('measured', 'predicted')[which]}{name}"
                    handle = server.scene.add_mesh_simple(path, mesh.vertices, mesh.faces, color=color, opacity=opacity)
                    self._handles.append((which, body, handle))
            server.scene.add_label(f"/label{which}", ("measured", "predicted")[which], position=(0.0, which * _APART, 0.9))
        self.slider = server.gui.add_slider("time [s]", 0.0, float(run.times[-1]), 0.01, 0.0)
        self.playing = server.gui.add_checkbox("play", True)
        self.show(0.0)

    def show(self, time: float) -> None:
        """Shows both robots as they were at a time [s]."""
        k = min(int(np.searchsorted(self._run.times, time)), len(self._run.times) - 1)
        poses = []
        for positions in (self._run.measured, self._run.predicted):
            self._data.qpos[:] = self._model.qpos0
            self._data.qpos[self._at] = positions[k]
            mujoco.mj_kinematics(self._model, self._data)
            poses.append((self._data.xpos.copy(), self._data.xquat.copy()))
        with self._server.atomic():
            for which, body, handle in self._handles:
                position, quaternion = poses[which][0][body], poses[which][1][body]
                handle.position, handle.wxyz = position + [0.0, which * _APART, 0.0], quaternion

    def step(self) -> None:
        """Shows the next picture; advances the time while playing."""
        if self.playing.value:
            self.slider.value = (self.slider.value + 1 / _RATE) % float(self._run.times[-1])
        self.show(self.slider.value)


def main(argv: Sequence[str]) -> None:
    """The command line.

    Raises:
        UserError: a file is missing or malformed, or the port is taken.
    """
    says = "Shows a logged run of an arm in a browser, beside the simulation's prediction, and prints how far they differ."
    parser = cli.Parser("replay", says)
    add = parser.add_argument
    add("log", type=cli.path(".csv"), help="log written by deploy --log or record")
    add("--robot", required=True, help="name of a robot, or folder of an imported one")
    add("--identified", type=cli.path(".yaml", ".yml"), help="file from identify, whose drives the simulation uses")
    add("--dt", type=cli.positive_float, help="physics step [s] (default: 0.005, or less for drives that oscillate fast)")
    add("--no-view", action="store_true", help="only print how far they differ")
    parser.add_address()
    args, _ = parser.parse(argv)
    robot = registry.robot(args.robot)
    run = run_of(args.log, robot, args.dt or usual_step(robot), args.identified)
    table = Table("predicted minus measured", ("joint", "rms [mrad, mm]", "largest [mrad, mm]"))
    largest = np.abs(run.predicted - run.measured).max(axis=0)
    for name, rms, most in zip(robot.arm.joints, run.errors(), largest, strict=True):
        table.add(name, f"{1e3 * rms:.1f}", f"{1e3 * most:.1f}")
    screen().print(table)
    if not args.no_view:
        _serve(robot, run, args.host, args.port)


def _serve(robot: RobotCfg, run: Run, host: str, port: int) -> None:
    """Serves the page until Ctrl-C."""
    need("viser")
    from mjx_nero.tools.view import door

    page, guard = door.open_page(host, port)
    picture, over = Picture(page.server, scene.robot_model(robot, whole=True), robot, run), threading.Event()
    print(f"{guard.url}  (Ctrl-C ends it)", flush=True)
    try:
        while not over.wait(1 / _RATE):
            picture.step()
    finally:
        guard.close()
        page.close()
