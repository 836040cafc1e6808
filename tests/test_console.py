"""What programs say: every word whole at any width, brackets as they are; and what a run shows as it goes on."""

import io
import math

import pytest
from rich.console import Console

from mjx_nero.runs import console


def test_the_progress_line_fits_80_columns_with_all_that_it_says():
    out = io.StringIO()
    terminal = Console(file=out, force_terminal=True, width=80, color_system=None)
    with console.Show(terminal, 1_000_000_000, 0.0) as show:
        show.update(123_456_789, 100.0, 4_123_456.0, 0.934)
    text = out.getvalue()
    assert "12%" in text and "123.5/1000.0 M steps  4,123,456/s  success 0.93  ETA 03:33" in text and "…" not in text


@pytest.mark.parametrize(
    ("steps", "rate", "minutes", "wall", "left"),
    [
        (6000, 100.0, 0.0, 30.0, 60.0),  # no limit
        (6000, 1.0, 10.0, 30.0, 570.0),  # the ten minutes end first
        (6000, 100.0, 10.0, 30.0, 60.0),
        (6000, 1.0, 10.0, 601.0, 0.0),
        (6000, 0.0, 0.0, 0.0, math.inf),
    ],
)
def test_time_left(steps, rate, minutes, wall, left):
    assert console.time_left(steps, rate, minutes, wall) == left


def test_the_line_of_a_video_counts_its_frames():
    out = io.StringIO()
    terminal = Console(file=out, force_terminal=True, width=80, color_system=None)
    with console.drawing(terminal, "video.mp4") as update:
        update(30, 120)
    assert "25%" in out.getvalue() and "drawing video.mp4, 30/120 frames  ETA " in out.getvalue()


def test_what_is_said_of_compiling_is_true_of_the_physics():
    assert "at every start" in console.compiling("native", on_cpu=False)  # JAX keeps no accelerator's program that calls back
    kept = [console.compiling("native", True), console.compiling("jax", True), console.compiling("warp", False)]
    assert all("the first time" in said for said in kept)


def test_clock():
    assert [console.clock(s) for s in (0.4, 61, 3600, 86_399)] == ["00:00", "01:01", "1:00:00", "23:59:59"]


def printed(view, width):
    screen = Console(width=width)
    with screen.capture() as said:
        screen.print(view)
    return said.get()


TABLE = console.Table("joints [rad]", ("joint", "range [rad]", "kind"), left=("kind",), caption="a caption")
TABLE.add("left_outer_knuckle_joint", "-1.5708 .. 1.5708", "hinge, follows [red]right_outer_knuckle_joint[/red]")
TABLE.add("j2", "unlimited", "slide")


@pytest.mark.parametrize("width", [80, 100, 200])
def test_no_word_is_broken(width):
    text = printed(TABLE, width)
    words = {"left_outer_knuckle_joint", "j2", "-1.5708", "1.5708", "unlimited", "slide", "[red]right_outer_knuckle_joint[/red]"}
    assert words <= set(text.split()) and "joints [rad]" in text and "a caption" in text
    assert max(map(len, text.splitlines())) <= width
    assert text.count("left_outer_knuckle_joint") == (2 if width == 80 else 1)


def test_a_column_that_wraps_keeps_the_table_in_one_piece():
    table = console.Table("t", ("name", "text"), left=("text",), wraps=("text",))
    table.add("first", "one two three " * 10)
    text = printed(table, 50)
    assert text.count("first") == 1 and text.count("three") == 10 and max(map(len, text.splitlines())) <= 50


def test_a_wide_table_is_one():
    lines = [line.split() for line in printed(TABLE, 200).splitlines() if line.split()]
    assert lines[0] == ["joints", "[rad]"] and lines[1] == ["joint", "range", "[rad]", "kind"]
    assert lines[4][:2] == ["j2", "unlimited"] and lines[4][2:] == ["slide"]


def test_a_line_is_not_wrapped_or_styled():
    screen = Console(width=20)
    with screen.capture() as said:
        console.line(screen, "plot: [bold]a long name of a file.png")
    assert said.get() == "plot: [bold]a long name of a file.png\n"
