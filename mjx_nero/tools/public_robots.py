"""Makes the table of public robots: imports each robot of a list and runs its self-test. See --help."""

import pathlib
import re
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

from mjx_nero import files
from mjx_nero.config import values
from mjx_nero.errors import UserError
from mjx_nero.tools import cli

TRIES = 16
MARKS = '"placed": ', '"failed": "'  # of a file of results
ENOUGH = 14  # successful tries for a robot to count
_LONGEST = 300  # seconds for an import and its self-test
_COLUMNS = ("robot", "repository, commit", "file", "flags", "opening", "grasped", "placed", "warnings")


@dataclass(frozen=True)
class Public:
    """A robot's description in a public repository."""

    repository: str
    """OWNER/NAME."""
    file: str
    """Path in the repository."""
    flags: str = ""
    """Further flags of import-urdf."""
    packages: tuple[str, ...] = ()
    """Folders OWNER+NAME/... of packages that it uses; NAME=OWNER+NAME/... for one that it calls by another name."""


def main(argv: Sequence[str]) -> None:
    """The command line."""
    parser = cli.Parser("public-robots", "Imports every robot of a list, runs its self-test, and writes the table of results.")
    parser.add_argument("list", type=cli.path(".yaml"), help="YAML file of repositories with their commits, and of robots")
    parser.add_argument(
        "--folder", type=cli.path(), required=True, help="folder that contains the repositories, each as OWNER+NAME"
    )
    parser.add_argument(
        "--json", type=cli.output(".json", marks=MARKS), required=True, help="file of results; new ones are added to it"
    )
    parser.add_argument(
        "--markdown",
        type=cli.output(".md", marks=("The importer accepts",)),
        help="write the tables of all results in the JSON file",
    )
    parser.add_argument(
        "--robots", help="list of robots, or none to only write the table (default: all robots that the JSON file lacks)"
    )
    parser.add_argument("--jobs", type=cli.at_most(100), default=1, help="number of robots to import at once")
    args, _ = parser.parse(argv)
    held = figures(args.json) if args.json.exists() else {}
    commits, robots = read(args.list)
    if args.robots == "none":
        names = []
    else:
        names = cli.choices(args.robots, "robot", robots) if args.robots else [n for n in robots if n not in held]
    with ThreadPoolExecutor(args.jobs) as pool:
        for name, row in zip(names, pool.map(lambda name: trial(robots[name], args.folder), names), strict=True):
            held[name] = row
            files.write_json(args.json, held)  # each time: a killed process leaves what it has measured
            print(f"{name}: {row.get('reason') or _said(row)}", file=sys.stderr)
    if args.markdown:
        files.write(args.markdown, markdown(commits, robots, held).encode())


def read(path: pathlib.Path) -> tuple[dict[str, str], dict[str, Public]]:
    """Returns commits by repository, and robots by name.

    Raises:
        UserError: the file is not such a list.
    """
    held = files.read_yaml(path)
    if (
        not isinstance(held, dict)
        or set(held) != {"repositories", "robots"}
        or not all(isinstance(v, dict) for v in held.values())
    ):
        raise UserError(f"{path} is not a list of robots: give it the mappings 'repositories' and 'robots'")
    commits = {name: values.read(str, commit, name) for name, commit in held["repositories"].items()}
    robots = {name: values.read(Public, robot, f"robots.{name}") for name, robot in held["robots"].items()}
    for name, robot in robots.items():
        if "," in name:
            raise UserError(f"{path}: {name!r} has a comma, which separates names in --robots: rename it")
        if robot.repository not in commits:
            raise UserError(f"{path}: {name}: {values.unknown('repository', robot.repository, commits)}")
    return commits, robots


def figures(path: pathlib.Path) -> dict[str, Any]:
    """Reads the figures of a JSON file.

    Raises:
        UserError: the file is not JSON, or has other rows.
    """
    held = files.read_json(path)
    rows = held.values() if isinstance(held, dict) else [held]
    if not all(isinstance(row, dict) and {"self_test", "failed"} & row.keys() for row in rows):
        raise UserError(f"{path} holds no results of public-robots: name another file")
    return held


def trial(robot: Public, folder: pathlib.Path) -> dict[str, Any]:
    """Imports a robot and returns its self-test, or the line that says why the import failed."""
    source = folder / robot.repository.replace("/", "+") / robot.file
    packages = [word for package in robot.packages for word in ("--package", _below(folder, package))]
    with tempfile.TemporaryDirectory() as scratch:
        out = pathlib.Path(scratch, "robot")
        failed = _failure("import-urdf", source, "--out", out, "--tries", TRIES, *packages, *shlex.split(robot.flags))
        return {"failed": "import", "reason": failed.replace(f"{folder}/", "")} if failed else _imported(out, folder)


def _below(folder: pathlib.Path, package: str) -> str:
    """Formats a package of the list for import-urdf's --package."""
    name, sign, path = package.rpartition("=")
    return f"{name}{sign}{folder / path}"


def _failure(command: str, *words: object) -> str:
    """Runs a command; returns its last line of output if it fails, else an empty text."""
    line = [sys.executable, "-m", "mjx_nero", command, *map(str, words)]
    try:
        done = subprocess.run(line, capture_output=True, text=True, timeout=_LONGEST, check=False)
    except subprocess.TimeoutExpired:
        return f"takes more than {_LONGEST} s"
    lines = done.stderr.strip().splitlines() or [f"exit {done.returncode}"]
    return lines[-1].removeprefix("error: ") if done.returncode else ""


def _imported(out: pathlib.Path, folder: pathlib.Path) -> dict[str, Any]:
    """Collects what an import says of the gripper, its warnings and its self-test."""
    robot, report = files.read_yaml(out / "robot.yaml"), files.read_json(out / "report.json")
    return {
        "gripper": list(robot["gripper"] or ()),
        "opening": robot["opening"],
        "warnings": [text.replace(f"{folder}/", "") for text in report["warnings"]],
        "self_test": {name: report["self_test"][name] for name in ("script", "tries", "good", "placed", "passed", "line")},
    }


def markdown(commits: Mapping[str, str], robots: Mapping[str, Public], held: Mapping[str, dict[str, Any]]) -> str:
    """Returns two tables as Markdown: one row for each robot that was tried, then what is wrong with those that fail."""
    tested = [row["self_test"] for row in held.values() if "failed" not in row]
    good, placed = (sum(row["script"] == "pick_place" and row[name] >= ENOUGH for row in tested) for name in ("good", "placed"))
    lines, failing = [_COLUMNS, ("---",) * len(_COLUMNS)], [("robot", "what the import says"), ("---", "---")]
    for name, robot in robots.items():
        if row := held.get(name):
            where = f"{robot.repository} {commits[robot.repository]}"
            flags = " ".join([robot.flags, *(f"--package {package}" for package in robot.packages)]).strip()
            opening = f"{1000 * row['opening']:.0f} mm" if row.get("opening") else ""
            warned = str(len(row.get("warnings", ())) or "")
            cells = name, where, robot.file, flags and f"`{flags}`", opening
            lines.append((*cells, _share(row, "good"), _share(row, "placed"), warned))
            if wrong := row.get("reason") or (not row["self_test"]["passed"] and _said(row)):
                failing.append((name, re.sub(r"[|<]", r"\\\g<0>", wrong)))
    every, failed = ("".join(f"| {' | '.join(line)} |\n" for line in rows) for rows in (lines, failing))
    counts = f"The importer accepts {len(tested)} of {len(held)} robots. {good} grasp the cube in at least {ENOUGH} of {TRIES}"
    return f"{counts} tries, {placed} also put it where it belongs in as many.\n\n{every}\n## Those that fail\n{failed}"


def _said(row: Mapping[str, Any]) -> str:
    return str(row["self_test"]["line"])


def _share(row: Mapping[str, Any], what: str) -> str:
    """Formats how many tries of the script succeeded; empty if there were none."""
    found = row.get("self_test", {"script": ""})
    return f"{found[what]} of {found['tries']}" if found["script"] == "pick_place" else ""
