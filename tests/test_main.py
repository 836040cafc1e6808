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
