"""Generated pages of the site: commands, configs, notebooks. conf.py calls it at every build."""

import contextlib
import importlib
import io
import os
import pathlib
import sys

import nbformat

import mjx_nero
from mjx_nero import config, control
from mjx_nero.__main__ import COMMANDS
from mjx_nero.learn import learner

ROOT = pathlib.Path(__file__).resolve().parents[1]
FIELDS = "any config field, with its default:"
TUTORIALS = {  # notebook -> its picture
    "01_nero_lift": "lift.png",
    "02_cobotta_motion": "pick_place.png",
    "03_bring_your_own_arm": "reach.png",
    "04_onto_the_arm": "so_arm101.png",
    "05_what_it_sees": "gallery/nero_lift_rgb.webp",
}


def pages(folder: pathlib.Path) -> None:
    """Writes all pages. A page that has not changed keeps its date, so Sphinx does not read it again."""
    folder.mkdir(exist_ok=True)
    found = {"commands": commands(), "config": configs(), **{name: tutorial(name) for name in TUTORIALS}}
    for name, text in found.items():
        path = folder / f"{name}.md"
        if not path.exists() or path.read_text() != text:
            path.write_text(text)


def help_of(command: str, *argv: str) -> str:
    """Returns a command's ``--help``, 100 columns wide."""
    module, function, _ = COMMANDS[command]
    before, out = (sys.argv, os.environ.get("COLUMNS")), io.StringIO()
    sys.argv, os.environ["COLUMNS"] = ["mjx-nero"], "100"
    try:
        with contextlib.redirect_stdout(out), contextlib.suppress(SystemExit):
            getattr(importlib.import_module(module), function)([*argv, "--help"])
    finally:
        sys.argv = before[0]
        os.environ.pop("COLUMNS") if before[1] is None else os.environ.update(COLUMNS=before[1])
    return out.getvalue()


def commands() -> str:
    """Returns one section per command: its help without the config fields, which have their own page."""
    text = "# Commands\n\n`mjx-nero COMMAND` and `python -m mjx_nero COMMAND` are the same. "
    text += "`train.py` and `eval.py` are the first two.\n"
    for name, (_, _, what) in COMMANDS.items():
        usage = help_of(name).partition(FIELDS)[0].rstrip()
        text += f"\n## {name}\n{what[0].upper()}{what[1:]}.\n\n```text\n{usage}\n```\n"
    return text + "\n[Configs](config.md) lists the fields that `train`, `eval` and others take by dotted names.\n"


def configs() -> str:
    """Lists every field of the lift and reach tasks, of PPO and of the controllers."""
    text = "# Configs\n\nEvery field is a flag, `--env.sim.dt 0.005`, and those of environments are arguments of `make`. "
    text += "Other tasks have fields of the same kinds; `--help` lists those of the environment that `--env` names.\n"
    for title, prefix, cfg in (
        ("Lift: `nero_lift`", "--env.", mjx_nero.env_cfg("nero_lift")),
        ("Reach: `nero_reach`", "--env.", mjx_nero.env_cfg("nero_reach")),
        ("PPO", "--ppo.", learner.cfg_for("ppo", "default", {})),
        *((f"Controller: `{name}`", "--control.", cfg) for name, (_, cfg) in control.CONTROLLERS.items()),
    ):
        text += f"\n## {title}\n| {prefix}... | default | |\n| --- | --- | --- |\n" + table(cfg)
    return text


def table(cfg: object) -> str:
    """Returns one row per field: name, default, description."""
    about = config.describe(cfg)
    rows = [(f"`{name}`", f"`{value!r}`" if value != "" else "", about[name]) for name, value in config.flatten(cfg).items()]
    return "".join(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in row)} |\n" for row in rows)


def tutorial(name: str) -> str:
    """Returns a notebook as a page: text, code and one picture."""
    notebook = nbformat.read(ROOT / "notebooks" / f"{name}.ipynb", as_version=4)
    title, *cells = [c.source if c.cell_type == "markdown" else f"```python\n{c.source}\n```" for c in notebook.cells]
    title, _, text = title.partition("\n")
    link = f"[The notebook](../../notebooks/{name}.ipynb): `jupyter lab notebooks/{name}.ipynb`."
    return "\n\n".join([title, f"![](../{TUTORIALS[name]})", link, text, *cells])
