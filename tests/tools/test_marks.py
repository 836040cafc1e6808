"""Each kind of table, YAML and JSON has a mark of its own: a command replaces files of its kind, and no other command's."""

import pathlib
import re
import shutil
import types

import numpy as np
import pytest

from mjx_nero import UserError, files
from mjx_nero.deploy import check
from mjx_nero.deploy.log import Log
from mjx_nero.identify import Fit, RecordCfg, record
from mjx_nero.identify import log as logs
from mjx_nero.identify.plant import Drives, Plant
from mjx_nero.tasks import registry
from mjx_nero.tools import public_robots, results
from mjx_nero.tools.deploy.command import NOTE
from mjx_nero.tools.identification import report
from mjx_nero.tools.tuning import report as tuning

JOINTS, ROOT = ("j1",), pathlib.Path(__file__).parents[2]


def drives_file(path):
    one = Drives(*np.ones((5, 1)))
    report.save(path, "arm", "log.csv", JOINTS, Fit(one, one, one, *np.zeros((5, 1))))


def check_file(path):
    path.write_text(check.yaml_of("arm", [check.Joint("j1", "j1", 1.0, 0.0, 0.01)], JOINTS))


def gains_file(path):
    robot = registry.robot("nero")
    tuning.save_gains(types.SimpleNamespace(robot=robot, tuned=robot), path)


def simulated_log(path):
    log, _ = record(Plant(registry.robot("nero"), 0.01), RecordCfg(seconds=10.0))
    logs.write(path, log, registry.robot("nero").arm.joints, ["robot: nero", report.SIMULATED])


def run_log(note):
    def write(path):
        Log(path, JOINTS, np.zeros(1), 0.0, 0, ["robot: arm", note]).close()

    return write


def page_of(name):
    """Writes the figures of a page of the documentation."""
    return lambda path: shutil.copy(ROOT / "docs" / name, path)


KINDS = {  # what writes it, and the mark by which its command knows it
    "identify --out": (drives_file, (report.MARK,)),
    "deploy --check": (check_file, (check.MARK,)),
    "tune-gains --out": (gains_file, (tuning.MARK,)),
    "record": (simulated_log, (report.SIMULATED, report.MOVEMENT)),
    "record --arm": (run_log(f"arm by sim, {report.MOVEMENT}"), (report.SIMULATED, report.MOVEMENT)),
    "results --json": (page_of("benchmarks.json"), results.MARKS),
    "public-robots --json": (page_of("public_robots.json"), public_robots.MARKS),
    "deploy --log": (run_log(f"nero_reach on sim{NOTE}p.onnx"), (NOTE,)),
}


@pytest.mark.parametrize("name", KINDS)
def test_a_file_is_replaced_by_its_own_kind_alone(tmp_path, name):
    write, own = KINDS[name]
    write(tmp_path / "file")
    for _, marks in KINDS.values():
        if marks == own:
            files.check_writable(tmp_path / "file", marks)
        else:
            with pytest.raises(UserError, match="it exists and is another kind of file"):
                files.check_writable(tmp_path / "file", marks)


def test_every_command_that_writes_text_has_marks():
    text = ".csv", ".json", ".md", ".yaml"
    sources = {path: path.read_text() for path in (ROOT / "mjx_nero").rglob("*.py")}
    outputs = [(path, call) for path, source in sources.items() for call in re.findall(r"cli\.output\((.*)\)", source)]
    assert len(outputs) > 15
    assert not [found for found in outputs if any(f'"{suffix}"' in found[1] for suffix in text) and "marks=" not in found[1]]
