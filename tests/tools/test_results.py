"""The table of results: what is measured is kept, and shown as it was measured."""

import json
import pathlib

import pytest

from mjx_nero.runs import cfg as run_cfg
from mjx_nero.tasks import registry
from mjx_nero.tools import results
from mjx_nero.tools.benchmark import learning

LEARNT = {"target": 0.95, "seeds": 8, "reached": 7, "seconds_median": 10.04, "seconds_worst": None}
LEARNT |= {"env_steps_median": 2_400_000, "env_steps_worst": None, "version": "9.9", "machine": "a GPU"}
PLAYED = {"success_rate": 0.9, "success_rate_95": [0.8, 0.95], "episodes": 1000, "version": "9.9", "machine": "a CPU"}


@pytest.fixture(scope="module")
def learnable() -> list[str]:
    return results.learnable()


def test_cells():
    assert list(results.rows({"x_lift": {"learning": LEARNT, "native": PLAYED}, "y_reach": {"warp": PLAYED}})) == [
        (
            *("x_lift", "95%", "7 of 8", "median 10.0, worst never", "median 2.4 M, worst never"),
            *("90.0% (80.0 to 95.0), 1,000 episodes", "", "9.9, a GPU; 9.9, a CPU"),
        ),
        ("y_reach", "", "", "", "", "", "90.0% (80.0 to 95.0), 1,000 episodes", "9.9, a CPU"),
    ]


def test_the_page_has_a_table_for_each_task():
    """Arms of one task share a table, in which no column is empty; a task may have its name in that of another."""
    cells = [("nero_lift", "95%", "8 of 8", "", "", "99%", "", "9.9"), ("nero_lift_obstacles", *[""] * 4, "97%", "", "9.9")]
    page = results.page([*cells, ("so101_lift", *[""] * 4, "98%", "", "9.9")], "r.json", "r.md")
    lift, obstacles = page.split("\n## ")[1:]
    assert lift.splitlines() == [
        "lift",
        "| environment | target | seeds | policy in MuJoCo C | measured with |",
        "| --- | --- | --- | --- | --- |",
        "| nero_lift | 95% | 8 of 8 | 99% | 9.9 |",
        "| so101_lift |  |  | 98% | 9.9 |",
    ]
    assert obstacles.splitlines()[0] == "lift_obstacles" and obstacles.splitlines()[3] == "| nero_lift_obstacles | 97% | 9.9 |"
    assert "--json docs/r.json --markdown docs/r.md" in page


def test_every_environment_has_a_task(learnable):
    """Those that are to be learnt belong to tasks of any robot."""
    assert {results.task_of(name) for name in learnable} <= set(registry.list_envs())
    assert results.task_of("drag") == "drag"  # a guest's
    assert results.task_of(results.named("so101_lift_obstacles", "default")) == "lift_obstacles"
    assert results.task_of(results.named("so101_lift", "sim2real")) == "lift sim2real"


def test_the_page_of_the_documentation_is_what_its_figures_give():
    docs = pathlib.Path(__file__).parents[2] / "docs"
    cells = list(results.rows(results.read(docs / "benchmarks.json")))
    assert (docs / "benchmarks.md").read_text() == results.page(cells, "benchmarks.json", "benchmarks.md")


def test_environments_to_learn(learnable):
    assert {"nero_lift", "so101_reach", "cobotta_stack"} <= set(learnable)
    assert "nero_pick_place" not in learnable and "reach" not in learnable  # a controller's, and any robot's


@pytest.mark.slow
def test_command(call, tmp_path):
    """What the file holds already stays; what is measured anew takes its place."""
    (tmp_path / "r.json").write_text(json.dumps({"so101_reach": {"learning": LEARNT, "native": PLAYED}}))
    flags = ("--what", "policies", "--envs", "so101_reach", "--episodes", 4)
    code, out, err = call("mjx_nero", "results", "--json", "r.json", "--markdown", "r.md", *flags)
    assert code == 0, err
    held = json.loads((tmp_path / "r.json").read_text())["so101_reach"]
    assert held["learning"] == LEARNT and held["native"]["episodes"] == 4 and held["native"]["version"] != "9.9"
    assert "7 of 8" in (tmp_path / "r.md").read_text() and "so101_reach" in out


def test_seeds_are_kept_one_by_one(call, tmp_path, monkeypatch):
    """A command that ends in seed 2 leaves two; the next one gets them, unless other settings are asked for."""
    given = []

    def measure(run, seeds, target, kept=()):
        given.append([row["seed"] for row in kept])
        for seed in range(seeds):
            if seed == 2 and len(given) == 1:
                raise KeyboardInterrupt
            yield {"seed": seed, "success_rate": 1.0, "env_steps": 10}
        yield {"seed": "all", **LEARNT}

    monkeypatch.setattr(learning, "measure_learning", measure)
    argv = ("results", "--json", "r.json", "--what", "learning", "--envs", "nero_reach", "--seeds")
    code, _, err = call("mjx_nero", *argv, 3)
    held = json.loads((tmp_path / "r.json").read_text())["nero_reach"]
    assert code == 130 and "Traceback" not in err and [row["seed"] for row in held["seeds"]["rows"]] == [0, 1]
    code, out, _ = call("mjx_nero", *argv, 3)
    assert code == 0 and given == [[], [0, 1]] and "7 of 8" in out
    assert json.loads((tmp_path / "r.json").read_text())["nero_reach"].keys() == {"learning"}
    held["seeds"]["num_envs"] += 1
    (tmp_path / "r.json").write_text(json.dumps({"nero_reach": held}))
    assert call("mjx_nero", *argv, 3)[0] == 0 and given[-1] == []


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (("--json", "r.json", "--envs", "nope"), "unknown env nope: choose from"),
        (("--json", "r.json", "--what", "x"), "unknown what x: choose from learning, policies"),
        (("--json", "r.json", "--envs", "nero_reach", "--preset", "rgb"), "none of these environments has the preset 'rgb'"),
        (("--json", "bad.json"), "bad.json holds no results: name another file"),
        ((), "--json"),
    ],
)
def test_mistakes(call, tmp_path, flags, said):
    (tmp_path / "bad.json").write_text('{"a": {"native": {"b": 3}}}')
    code, _, err = call("mjx_nero", "results", *flags)
    assert code == 2 and said in err and not (tmp_path / "r.json").exists()


def test_what_sees_is_taught_by_its_own_learner():
    assert run_cfg.resolve("nero_lift", "rgb", None, {}, {}).learner == "distill"
    assert run_cfg.resolve("nero_lift", "default", None, {}, {}).learner == "ppo"
