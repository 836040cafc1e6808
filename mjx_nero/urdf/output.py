"""The model folder: written whole or not at all."""

import dataclasses
import pathlib
import shutil
import uuid
from collections.abc import Mapping

import mujoco

from mjx_nero import robot_file
from mjx_nero.robots import RobotCfg
from mjx_nero.types import UserError
from mjx_nero.urdf.notes import Report

_OURS = ("model.xml", robot_file.NAME, "report.json")


def check(out: pathlib.Path, force: bool) -> None:
    """Whether the folder may be made.

    Raises:
        UserError: it holds something; with ``force`` something else than an earlier import.
    """
    if out.is_symlink() or out.exists() and not out.is_dir():
        raise UserError(f"{out} is not a folder: pass another --out")
    if not out.exists() or not any(out.iterdir()):
        return
    if not all((out / name).is_file() for name in _OURS):
        raise UserError(f"{out} holds other files: pass another --out")
    if not force:
        raise UserError(f"{out} holds an imported robot: pass --force to replace it, or another --out")


def write(out: pathlib.Path, text: str, stl: Mapping[str, bytes], robot: RobotCfg, report: Report, force: bool) -> None:
    """Makes the folder beside its place, hidden, and moves it there once MuJoCo has taken the model.

    Raises:
        UserError: it cannot be written, or MuJoCo refuses the model.
    """
    made = out.parent / f".{out.name}.{uuid.uuid4().hex[:8]}"
    try:
        made.mkdir(parents=True)
        (made / "model.xml").write_text(text, encoding="utf-8")
        if stl:
            (made / "meshes").mkdir()
        for name, content in stl.items():
            (made / "meshes" / f"{name}.stl").write_bytes(content)
        (made / "report.json").write_text(report.json(), encoding="utf-8")
        robot_file.write(made, dataclasses.replace(robot, folder=str(made)))
        mujoco.MjModel.from_xml_path(str(robot_file.read(made).xml))
        check(out, force)
        old = out.parent / f"{made.name}.old"
        if out.exists():
            out.rename(old)
        try:
            made.rename(out)
        except BaseException:
            if old.exists():
                old.rename(out)
            raise
        shutil.rmtree(old, ignore_errors=True)
    except OSError as error:
        raise UserError(f"cannot write {out}: {error.strerror or error}; pass another --out") from None
    except ValueError as error:
        if isinstance(error, UserError):
            raise
        raise UserError(f"MuJoCo refuses the model: {' '.join(str(error).split())}") from None
    finally:
        if made.exists():
            shutil.rmtree(made, ignore_errors=True)
