"""The tables of public robots: their list, what they say of a robot, and of one that fails."""

import json
from pathlib import Path

import pytest

from mjx_nero.tools import public_robots
from mjx_nero.types import UserError
from tests import urdf_files

LIST = Path(__file__).parents[2] / "docs" / "public_robots.yaml"


def listed(folder: Path, text: str) -> Path:
    path = folder / "list.yaml"
    path.write_text(text)
    return path


def test_the_projects_own_list_names_arms_enough():
    commits, robots = public_robots.read(LIST)
    assert len(robots) >= 40 and {robot.repository for robot in robots.values()} <= set(commits)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[]", "is not a list of robots"),
        ("repositories: {}", "is not a list of robots"),
        ("repositories: {a/b: '1'}\nrobots: {r: {repository: a/c, file: r.urdf}}", "no repository 'a/c'"),
        ("repositories: {a/b: '1'}\nrobots: {r: {repository: a/b}}", "file"),
        ("repositories: {a/b: '1'}\nrobots: {'r, left': {repository: a/b, file: r.urdf}}", "comma"),
        ("repositories: {a/b: '1'}\nrobots: {r: {repository: a/b, file: r.urdf, flag: x}}", "'flag'"),
    ],
)
def test_a_list_with_a_mistake_ends_in_one_line(tmp_path, text, message):
    with pytest.raises(UserError, match=message):
        public_robots.read(listed(tmp_path, text))


def test_figures_that_are_none_are_refused(tmp_path):
    for text in ("[" * 100_000, "[]", "3", "{"):
        (tmp_path / "held.json").write_text(text)
        with pytest.raises(UserError, match="held.json"):
            public_robots.figures(tmp_path / "held.json")


@pytest.mark.slow
def test_a_robot_that_fails_stands_in_the_table_with_its_reason(tmp_path):
    urdf_files.write(tmp_path / "a+b", urdf_files.robot(urdf_files.base()), "box.urdf")
    path = listed(
        tmp_path,
        "repositories: {a/b: abc1234}\nrobots: {Box: {repository: a/b, file: box.urdf}, Other: {repository: a/b, file: x.urdf}}",
    )
    held, table = tmp_path / "held.json", tmp_path / "table.md"
    public_robots.main([str(path), "--folder", str(tmp_path), "--json", str(held), "--markdown", str(table)])
    rows = json.loads(held.read_text())
    assert {name: row["failed"] for name, row in rows.items()} == {"Box": "import", "Other": "import"}
    assert "no joint that moves" in rows["Box"]["reason"] and rows["Other"]["reason"] == "there is no file a+b/x.urdf"
    text = table.read_text()
    assert (
        text.startswith("The importer accepts 0 of 2 robots. 0 grasp")
        and "| Box | a/b abc1234 | box.urdf |" in text
        and f"| Box | {rows['Box']['reason']} |" in text.split("## Those that fail")[1]
    )


@pytest.mark.slow
def test_a_robot_that_imports_has_a_row_of_its_self_test(tmp_path, monkeypatch):
    monkeypatch.setattr(public_robots, "TRIES", 1)
    urdf_files.write(tmp_path / "a+b", urdf_files.arm(3), "arm.urdf")
    row = public_robots.trial(public_robots.Public("a/b", "arm.urdf"), tmp_path)
    assert row["gripper"] == [] and row["self_test"]["line"].startswith("self-test: ")


def test_the_table_counts_robots_that_mostly_succeed():
    robots = {"A": public_robots.Public("a/b", "a.urdf", "--arg x:=1", ("c+d/e",)), "B": public_robots.Public("a/b", "b.urdf")}
    row = {"gripper": ["jaw"], "opening": 0.08, "warnings": ["B: small"]}
    tried = {"script": "pick_place", "tries": 16, "good": 14, "placed": 13, "passed": False, "line": "self-test: a|lost"}
    held = {"A": row | {"self_test": tried}, "B": row | {"self_test": tried | {"script": "reach", "good": 16}}}
    text = public_robots.markdown({"a/b": "abc1234"}, robots, held)
    assert (
        text.startswith("The importer accepts 2 of 2 robots. 1 grasp the cube in at least 14 of 16 tries, 0 also put it")
        and "`--arg x:=1 --package c+d/e` | 80 mm | 14 of 16 | 13 of 16 | 1 |" in text
        and "| b.urdf |  | 80 mm |  |  | 1 |" in text
        and "| A | self-test: a\\|lost |" in text.split("## Those that fail")[1]
    )


def test_the_page_has_the_tables_of_its_figures():
    commits, robots = public_robots.read(LIST)
    held = public_robots.figures(LIST.with_suffix(".json"))
    assert public_robots.markdown(commits, robots, held) in LIST.with_suffix(".md").read_text()
