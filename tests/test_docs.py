"""What the documents say: links lead somewhere, commands exist and leave a clone clean, nothing is large; the site is whole."""

import ast
import fnmatch
import itertools
import pathlib
import re
import shlex
import subprocess
import sys
import tomllib

import pytest
import yaml
from PIL import Image

import mjx_nero
from mjx_nero import config
from mjx_nero.__main__ import COMMANDS
from mjx_nero.errors import EXTRAS
from mjx_nero.learn import header, policy
from mjx_nero.runs import cfg
from mjx_nero.sim import robot_file
from mjx_nero.tasks import registry
from mjx_nero.tools import cli, results

ROOT = pathlib.Path(__file__).parents[1]
DOCS = ROOT / "docs"
WRITTEN = sorted(page for page in DOCS.rglob("*.md") if "generated" not in page.parts)
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "SECURITY.md", *WRITTEN]
README = (ROOT / "README.md").read_text()
# Pages with Python, and who runs it. CONTRIBUTING's is parts of files; performance.md's measured a GPU of its time.
RUN = {
    "README.md": "tests/test_docs.py",
    "your_own_task.md": "tests/test_guests.py",
    "your_own_learner.md": "tests/test_guests.py",
    "demonstrations.md": "tests/tools/test_demos.py",
    "gymnasium.md": "tests/interop/test_gymnasium.py",
    "deploy_onnx.md": "tests/interop/test_onnx.py",
    "adding_an_arm.md": "tests/test_docs.py",
    "cameras.md": "tests/sim/test_cameras.py",
    "fixtures.md": "tests/sim/test_fixtures_physics.py",
    "objects.md": "tests/sim/test_meshes.py",
}

NO_BEGINNING = set(
    "about above after as at because before behind below beneath between beyond by for from if in into it its nothing now of on"
    " out over since so than that their them then they through till to toward towards under until up upon when where which"
    " while who whose why with within without what how none not yet".split()
)


def commands(text: str) -> list[list[str]]:
    """The words of every command of the package, in blocks of code and within a line; what a container is to do, too."""
    blocks = re.findall(r"^```\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    lines = [line for block in blocks for line in block.splitlines()]
    lines += re.findall(r"`(python [^`]+)`", re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL))
    lines = [re.sub(r"^podman run .* mjx-nero\S* ", "python -m mjx_nero ", line) for line in lines]
    found = [shlex.split(line, comments=True) for line in lines if line.startswith("python ")]
    return [words for words in found if words[1] in ("train.py", "eval.py") or words[2:3] == ["mjx_nero"] and words[3:]]


def test_docstrings_begin_with_what_a_thing_is_or_does():
    """Not with a preposition, a pronoun or a question word: see CONTRIBUTING."""
    found = []
    for path in sorted(file for file in (ROOT / "mjx_nero").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            text = ast.get_docstring(node) if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) else None
            if text and text.split()[0].strip(".,:;").lower() in NO_BEGINNING:
                found.append(f"{path.relative_to(ROOT)}: {text.splitlines()[0]}")
    assert not found


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_to_files(page):
    links = re.findall(r"\]\(([^)#]+)\)", page.read_text())
    assert not [link for link in links if "://" not in link and not (page.parent / link).exists()]


def test_the_readme_is_a_page_and_shows_one_lift_and_a_thousand():
    assert len(README.splitlines()) <= 80
    assert re.findall(r"!\[.+\]\((docs/\w+\.webp)\)", README) == ["docs/lift.webp", "docs/thousand.webp"]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_commands_and_their_flags_exist(page, monkeypatch):
    """Every flag is one of the command's own, or a dotted one."""

    class Known(Exception):
        pass

    def parse(self, argv, prefixes=(), fields=None):
        raise Known(set(self._option_string_actions), prefixes)

    for words in commands(page.read_text()):
        name, argv = (words[1].removesuffix(".py"), words[2:]) if words[1].endswith(".py") else (words[3], words[4:])
        if name in ("--help", "COMMAND"):
            continue
        assert name in COMMANDS, words
        if name == "import-urdf":
            continue  # parses by itself; its flags are tested with it
        monkeypatch.setattr(cli.Parser, "parse", parse)
        with pytest.raises(Known) as known:
            __import__("importlib").import_module(COMMANDS[name][0]).__dict__[COMMANDS[name][1]]([])
        flags, prefixes = known.value.args
        prefixes = prefixes() if callable(prefixes) else prefixes
        used = [word.partition("=")[0] for word in argv if word.startswith("--")]
        wrong = [flag for flag in used if flag not in flags and flag.removeprefix("--").partition(".")[0] not in prefixes]
        assert not [flag for flag in wrong if flag != "--help"], words


OWN = {"./my_arm": "nero", "./so101": "so_arm101", "./my_nero": "nero"}  # folders that a page's commands make


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_dotted_flags_name_fields_and_have_values_that_these_take(page):
    for words in commands(page.read_text()):
        given = {flag: value for flag, value in itertools.pairwise([*words, ""]) if flag.startswith("--")}
        fields: dict[str, dict[str, str]] = {}
        for flag, value in given.items():
            prefix, _, name = flag[2:].partition(".")
            if name:
                fields.setdefault(prefix, {})[name] = value
        if "--load" in given or not fields:
            continue
        env = next((word for word in words if word in mjx_nero.list_envs()), "nero_lift")
        preset, robot = given.get("--preset", "default"), given.get("--robot")
        run = cfg.resolve(env, preset, OWN.get(robot, robot), fields.pop("env", {}), {}, given.get("--learner", ""))
        for learner, changes in fields.items():
            assert learner == run.learner, words
            config.override(run.hyperparameters, changes)


def test_the_first_commands_leave_a_clone_clean():
    """What those of the README and of the pages to start with write in the root folder is ignored there."""
    ignored = [line.strip("/") for line in (ROOT / ".gitignore").read_text().splitlines() if line and not line.startswith("#")]
    outputs = ("--video", "--json", "--out", "--render", "--plot")
    first = [README, *(page.read_text() for page in (DOCS / "start").glob("*.md") if page.stem != "gallery")]
    found = [words for text in first for words in commands(text)]
    written = [word for words in found for flag, word in zip(words, words[1:], strict=False) if flag in outputs]
    assert len(written) >= 9
    assert not [name for name in written if not any(fnmatch.fnmatch(pathlib.Path(name).parts[0], rule) for rule in ignored)]


def test_nothing_is_above_two_megabytes():
    folders = ("assets", "docs", "mjx_nero", "notebooks", "tests")
    large = [path for folder in folders for path in (ROOT / folder).rglob("*") if path.is_file() and path.stat().st_size > 2e6]
    assert not large


def test_hooks_and_workflow_run_what_ci_runs():
    ci = (ROOT / ".ci" / "run").read_text()
    hooks = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"]
    assert [repo["repo"] for repo in hooks] == ["local"]  # nothing is downloaded
    entries = [hook["entry"] for hook in hooks[0]["hooks"]]
    for check in ("ruff check", "ruff format --check", "lint-imports", "mypy", "python -m pytest"):
        assert check in ci and any(entry.startswith(check) for entry in entries)
    (job,) = yaml.safe_load((ROOT / ".github" / "workflows" / "ci.yml").read_text())["jobs"].values()
    assert [step["run"] for step in job["steps"] if "run" in step] == [".ci/run"]


def test_the_citation_has_the_version_of_the_last_release():
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text())["version"] == mjx_nero.__version__


@pytest.mark.slow
def test_the_readmes_python_runs():
    (snippet,) = re.findall(r"^```python\n(.*?)^```", README, re.MULTILINE | re.DOTALL)
    names: dict = {}
    exec(snippet.replace("4096", "4"), names)
    assert names["state"].obs["state"].shape[0] == 4


def test_every_page_with_python_has_a_test_that_runs_it():
    with_python = {page.name for page in PAGES if re.search(r"^```python$", page.read_text(), re.MULTILINE)}
    assert with_python - {"CONTRIBUTING.md", "performance.md"} == set(RUN)
    assert not [page for page, test in RUN.items() if page not in (ROOT / test).read_text()]


def test_adding_an_arm_shows_the_module():
    page = (DOCS / "guides" / "adding_an_arm.md").read_text()
    (snippet,) = re.findall(r"^```python\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    module = (ROOT / "mjx_nero" / "tasks" / "arms" / "so_arm101.py").read_text()
    shown, there = ([line for line in re.sub(r" *#.*", "", text).splitlines() if line] for text in (snippet, module))
    assert there[-len(shown) :] == shown


def test_every_page_is_in_the_site():
    """All but the laboratory's are in its table of contents."""
    listed = set(re.findall(r"^([\w/]+)$", (DOCS / "index.md").read_text(), re.MULTILINE))
    pages = {page.relative_to(DOCS).with_suffix("").as_posix() for page in WRITTEN}
    kept = {page for page in pages if page.startswith("lab/")}
    assert {page for page in listed if not page.startswith("generated/")} == pages - kept - {"index"}
    index = (DOCS / "lab" / "index.md").read_text()
    assert all(f"({page.removeprefix('lab/')}.md)" in index for page in kept - {"lab/index"})


def test_the_gallery_has_every_environment_with_somebody_who_is_good_at_it():
    """A bundled policy, or the controllers that it is for."""
    there = {env for env in mjx_nero.list_envs() if registry.robot_of(env)}
    learnt = set(results.learnable())
    there -= {env for env in learnt if not policy.shipped(env).exists()}
    page = DOCS / "start" / "gallery.md"
    there |= {f"{env}_rgb" for env in learnt if policy.shipped(env, "rgb").stem == f"{env}_rgb"}
    rows = re.findall(r"^\| !\[(\w+)\]\((\S+)\) .*`python eval.py --env (.+?) --video", page.read_text(), re.MULTILINE)
    assert {name for name, _, _ in rows} == there
    for name, picture, played in rows:
        assert played.replace(" --preset ", "_") == name and (page.parent / picture).stat().st_size < 80_000
        with Image.open(page.parent / picture) as moving:
            assert moving.n_frames > 10  # the format joins those that are alike


def test_the_file_formats_are_those_that_are_read():
    page = (DOCS / "reference" / "files.md").read_text()
    for title, fields in (("robot.yaml", {*robot_file._PLAIN, "arm", "gripper"}), ("policy.safetensors", set(header._FIELDS))):
        section = page.split(f"## {title}")[1].split("\n## ")[0]
        named = {name for row in re.findall(r"^\| (`.*?) \|", section, re.MULTILINE) for name in re.findall(r"`(\w+)`", row)}
        assert named == fields, title


def test_the_extra_of_the_site_has_what_documented_modules_import():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert set(extras["gym"]) <= set(extras["docs"])  # the environment of the tests has it in any case


def test_the_extra_that_a_message_names_installs_the_package():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    projects = {"can": "python-can", "cv2": "opencv-python-headless", "serial": "pyserial"}  # of other names than their packages
    for package, extra in EXTRAS.items():
        project = projects.get(package, package.replace("_", "-"))
        assert [need for need in extras[extra] if re.split(r"[\[>]", need)[0] == project], package


@pytest.mark.slow
def test_the_site_is_built_without_a_warning(tmp_path):
    build = [
        sys.executable,
        "-m",
        "sphinx",
        "-W",
        "--keep-going",
        "-q",
        "-d",
        str(tmp_path / "cache"),
        str(DOCS),
        str(tmp_path / "site"),
    ]
    done = subprocess.run(build, capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    site = tmp_path / "site"
    assert "Ctrl-C saves and prints how to resume" in (site / "index.html").read_text()
    assert "lab/learning.html" not in (site / "guides" / "runs.html").read_text()  # out of the table of contents
    reference = (site / "generated" / "commands.html").read_text()
    assert all(f'id="{name}"' in reference for name in COMMANDS) and "--num-timesteps" in reference
    assert "actions.arm.params.ahead" in (site / "generated" / "config.html").read_text()
    assert "object_ee_distance" in (site / "reference" / "python.html").read_text()
    assert "cell_type" not in (site / "generated" / "01_nero_lift.html").read_text()


def test_the_containerfile_is_sound():
    """By its linter; and what it copies is there, and not left out."""
    linter = pathlib.Path(sys.executable).with_name("hadolint")
    done = subprocess.run([linter, ROOT / "Containerfile"], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    text, kept = (ROOT / "Containerfile").read_text(), (ROOT / ".containerignore").read_text().splitlines()
    copied = [name for line in re.findall(r"^COPY (.*) \S+$", text, re.MULTILINE) for name in line.split()]
    assert len(copied) >= 6 and all((ROOT / name).exists() and f"!{name}" in kept for name in copied)
