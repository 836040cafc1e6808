"""What is not there, for every command: unknown names, no files, folders for files, files for folders, files of another kind."""

import pytest
import urdf_files as make

from mjx_nero.__main__ import COMMANDS

READS = (  # X: what is read
    "train --env nero_reach --restore X --out run",
    "train --env nero_reach --load X.py --out run",
    "train --env reach --robot ./X --out run",
    "train --env nero_lift --object X.obj --out run",
    "train --env nero_lift --learner clone --clone.data X --out run",
    "train --env nero_lift --env.identified X.yaml --out run",
    "eval --env nero_reach --policy X",
    "eval --env nero_lift --policy X.safetensors --view",
    "eval --env lift --robot ./X",
    "eval --env cobotta_follow_target --agent rmpflow --control.config X.yaml",
    "view --env nero_reach --policy X",
    "view --run X",
    "view --demos X --episode 0",
    "view --env so101_lift --demos made --leader X --calibration X.json",
    "demos --env nero_lift --agent policy --policy X --out made --form arrays",
    "demos --env so101_reach --log X.csv --out made --form arrays",
    "demos --inspect X",
    "demos --replay X",
    "export X --out p.onnx",
    "deploy X.onnx --arm sim",
    "robustness --env nero_reach --policy X",
    "robustness --env nero_reach --plot p.png --beside X.json",
    "benchmark --robot ./X --env lift",
    "results --load X.py --json r.json --what none",
    "public-robots X.yaml --folder . --json r.json",
    "list-envs --load X.py",
    "inspect X",
    "inspect --object X.obj",
    "import-urdf X --out made",
    "import-urdf in/robot.urdf --gains X --out made",
    "tune-gains --robot ./X",
    "record --robot ./X --out log.csv",
    "replay X.csv --robot nero --no-view",
    "identify X.csv --robot nero",
    "identify X.csv --robot nero --out d.yaml --plot p.png",
)
NAMES = (  # X: a name that is not known
    "train --env X",
    "train --env nero_reach --learner X",
    "eval --env nero_lift --agent X",
    "eval --env nero_lift --backend X",
    "view --env nero_reach --agent X",
    "demos --env nero_lift --agent X --out made",
    "demos --env nero_lift --form X --out made",
    "export X --out p.onnx",
    "deploy p.onnx --arm X",
    "robustness --env nero_reach --only X",
    "benchmark --what X",
    "results --json r.json --what X",
    "public-robots list.yaml --folder . --json r.json --jobs X",
    "list-envs X",
    "inspect nero_lift --preset X",
    "import-urdf in/robot.urdf --out made --gripper X",
    "tune-gains --robot X",
    "record --robot X --out log.csv",
    "replay log.csv --robot X",
    "identify log.csv --robot X",
)
WRITES = (  # Y: what is written
    "eval --env nero_reach --json Y.json",
    "eval --env nero_reach --video Y.mp4",
    "demos --inspect demos --sheet Y.png",
    "demos --replay demos --video Y.mp4",
    "export nero_reach --out Y.onnx",
    "deploy p.onnx --arm sim --log Y.csv",
    "deploy p.onnx --arm sim --check Y.yaml",
    "robustness --env nero_reach --json Y.json",
    "robustness --env nero_reach --plot Y.png",
    "benchmark --json Y.json",
    "benchmark --plot Y.png",
    "results --json Y.json --what none",
    "results --json r.json --markdown Y.md --what none",
    "public-robots list.yaml --folder . --json Y.json",
    "public-robots list.yaml --folder . --json r.json --markdown Y.md",
    "inspect nero --render Y.png",
    "inspect nero_lift --cameras Y.png",
    "inspect nero --json Y.json",
    "tune-gains --robot nero --out Y.yaml",
    "tune-gains --robot nero --plot Y.png",
    "record --robot nero --out Y.csv",
    "identify log.csv --robot nero --out Y.yaml",
    "identify log.csv --robot nero --plot Y.png",
)
FOLDERS = (
    "train --env nero_reach --out Y",
    "demos --env nero_lift --agent policy --out Y --form arrays",
    "import-urdf in/robot.urdf --out Y",
    "view --env nero_lift --demos Y",
)
LOST = {
    "missing": lambda path: None,
    "folder": lambda path: path.mkdir(),
    "broken link": lambda path: path.symlink_to("nowhere"),
}


def test_every_command_is_here():
    for lines in (NAMES, READS):
        assert {line.split()[0] for line in lines} == set(COMMANDS)


def name_in(line, letter):
    return next(word for word in line.split() if word.removeprefix("./").split(".")[0] == letter)


@pytest.mark.parametrize("line", NAMES)
def test_a_name_that_is_not_known(refuse, line):
    def case(folder):
        make.write(folder / "work" / "in", make.arm(2))
        return line.split()

    said = refuse(case)
    assert "'X'" in said or " X" in said, said


@pytest.mark.parametrize("lost", LOST)
@pytest.mark.parametrize("line", READS)
def test_a_file_that_cannot_be_read(refuse, line, lost):
    def case(folder):
        make.write(folder / "work" / "in", make.arm(2))
        LOST[lost](folder / "work" / name_in(line, "X"))
        return line.split()

    said = refuse(case)
    assert "X" in said, said


@pytest.mark.parametrize("line", (*WRITES, *FOLDERS))
def test_a_file_where_a_folder_should_be(refuse, line):
    def case(folder):
        make.write(folder / "work" / "in", make.arm(2))
        (folder / "work" / "taken").write_text("mine")
        return [f"taken/{word}" if word == name_in(line, "Y") else word for word in line.split()]

    said = refuse(case)
    assert "taken" in said, said


@pytest.mark.parametrize("kind", ["folder", "another kind"])
@pytest.mark.parametrize("line", WRITES)
def test_what_is_there_is_not_replaced_by_another_kind(refuse, line, kind):
    def case(folder):
        path = folder / "work" / name_in(line, "Y")
        path.mkdir() if kind == "folder" else path.write_text('{"name": "mine"}')
        return line.split()

    said = refuse(case)
    assert name_in(line, "Y") in said, said
