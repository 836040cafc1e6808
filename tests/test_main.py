"""``python -m mjx_nero``: hands arguments to its commands."""

import pytest

from mjx_nero.__main__ import COMMANDS


def test_help_names_every_command(call):
    status, out, _ = call("mjx_nero", "--help")
    assert status == 0 and all(name in out for name in COMMANDS)


@pytest.mark.parametrize("command", COMMANDS)
def test_commands_have_help_of_their_own(call, command):
    status, out, err = call("mjx_nero", command, "--help")
    assert (status, err) == (0, "") and f"python -m mjx_nero {command}" in out


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        ([], "name a command: train, eval"),
        (["inspct", "nero"], "unknown command 'inspct' (did you mean 'inspect'?)"),
        (["inspect"], "name a robot, an environment or the folder of an imported robot"),
        (["inspect", "nero", "--rendr", "x"], "unknown argument '--rendr'"),
        (["import-urdf", "a.urdf"], "the following arguments are required: --out"),
    ],
)
def test_mistakes_end_in_one_line(call, argv, message):
    status, _, err = call("mjx_nero", *argv)
    assert status == 2 and err.startswith("error: ") and message in err and err.count("\n") == 1


@pytest.mark.parametrize(
    ("line", "names"),
    [
        ("inspect so_arm101 --json a.json", "a.json"),
        ("inspect --object mug --json a.json", "a.json"),
        ("record --robot so_arm101 --seconds 12 --rate 50 --out a.csv", "a.csv"),
        ("tune-gains --robot so_arm101 --out a.yaml --plot a.svg", "a.yaml a.svg"),
        ("tune-gains --robot so_arm101 --plot a.pdf", "a.pdf"),
        ("tune-gains --robot so_arm101 --plot a.png", "a.png"),
        ("export nero_reach --out a.onnx", "a.onnx"),
        ("eval --env nero_reach --episodes 2 --impl native --env.episode_length_s 0.2 --json a.json", "a.json"),
        ("results --json a.json --markdown a.md --what none", "a.md"),
    ],
)
def test_a_command_replaces_what_it_wrote_before(call, tmp_path, line, names):
    for _ in range(2):
        status, _, err = call("mjx_nero", *line.split())
        assert status == 0, err
    for name in names.split():
        assert (tmp_path / name).stat().st_size > 0
        (tmp_path / name).write_text("mine")
        status, _, err = call("mjx_nero", *line.split())
        assert status == 2 and f"cannot write {name}: it exists and is another kind of file" in err
        assert (tmp_path / name).read_text() == "mine"
        (tmp_path / name).unlink()
