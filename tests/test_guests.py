"""Outside code: the documentation's own example in every command, a backend of a page, and what is refused."""

import json
import pathlib
import re

import jax
import jax.numpy as jnp
import mujoco
import pytest

from mjx_nero import UserError, env_cfg, list_envs, list_presets, make, register
from mjx_nero.sim import physics
from mjx_nero.sim.physics import Footprint
from mjx_nero.tasks import registry
from mjx_nero.tools import cli
from mjx_nero.types import Sim

PAGE = pathlib.Path(__file__).resolve().parents[1] / "docs" / "guides" / "your_own_task.md"
EXAMPLE = re.search(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL).group(1)


@pytest.fixture(scope="module")
def drag(tmp_path_factory):
    """The page's file, as it stands."""
    path = tmp_path_factory.mktemp("guest") / "drag.py"
    path.write_text(EXAMPLE)
    return path


def test_the_page_is_one_file_that_every_listing_command_takes(call, drag):
    code, out, err = call("mjx_nero", "list-envs", "--load", drag)
    assert code == 0, err
    assert "drag" in out and "gantry" in out and "nero_lift" in out
    code, out, err = call("mjx_nero", "inspect", "--load", drag, "drag")
    assert code == 0, err
    assert "red_to_goal" in out and "Delay(steps=(1, 2), hold=1.0)" in out
    code, out, err = call("mjx_nero", "inspect", "--load", drag, "gantry")
    assert code == 0, err


def test_the_pages_controller_does_its_task(call, drag, tmp_path):
    flags = ("--preset", "scripted", "--controller", "catcher", "--episodes", 8, "--json", tmp_path / "result.json")
    code, _, err = call("eval", "--load", drag, "--env", "drag", *flags)
    assert code == 0, err
    result = json.loads((tmp_path / "result.json").read_text())
    assert result["success_rate"] == 1.0 and result["nan_count"] == 0


@pytest.mark.slow
def test_the_pages_task_is_trained_and_measured(call, drag, tmp_path):
    flags = ("--num-envs", 16, "--num-timesteps", 2048, "--ppo.unroll_length", 8, "--ppo.num_minibatches", 2, "--no-video")
    code, _, err = call("train", "--load", drag, "--env", "drag", *flags, "--out", tmp_path / "run")
    assert code == 0, err
    assert (tmp_path / "run" / "policy.safetensors").is_file()
    code, _, err = call("eval", "--load", drag, "--env", "drag", "--policy", tmp_path / "run/policy.safetensors", "--episodes", 2)
    assert code == 0, err
    code, out, err = call("mjx_nero", "benchmark", "--load", drag, "--env", "drag", "--num-envs", 4, "--steps", 3, "--repeats", 1)
    assert code == 0, err
    assert "native" in out


@pytest.mark.slow
def test_a_pages_learner_and_physics_train_play_and_are_measured(call, tmp_path):
    page = PAGE.with_name("your_own_learner.md").read_text()
    (tmp_path / "mine.py").write_text(re.search(r"```python\n(.*?)```", page, re.DOTALL).group(1))
    sizes = ("--num-envs", 8, "--num-timesteps", 128, "--search.step", 0.1, "--env.episode_length_s", 0.2, "--no-video")
    mine = ("--load", "mine.py", "--env", "nero_reach")
    code, out, err = call("train", *mine, "--learner", "search", "--impl", "perfect", *sizes, "--out", "run")
    assert code == 0 and "128 env steps" in out, err
    best = [json.loads(line).get("search/best") for line in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()]
    assert best[-1] > -1e9
    code, out, err = call("eval", *mine, "--policy", "run/policy.safetensors", "--episodes", 2, "--env.episode_length_s", 0.2)
    assert code == 0 and "success rate" in out, err
    flags = ("--impl", "perfect", "--learner", "search", "--num-envs", 4, "--steps", 3, "--repeats", 1)
    code, _, err = call("benchmark", *mine, *flags)
    assert code == 0, err


def test_help_knows_a_guests_fields(call, drag):
    code, out, _ = call("train", "--load", drag, "--env", "drag", "--help")
    assert code == 0 and "--env.scene.objects.red.mass 0.05" in out and "--env.actions.delay.params.steps (1, 2)" in out


def test_fields_of_a_guest_are_overridden_by_dotted_name(drag):
    cli.load_guests([str(drag)])
    env = make("drag", impl="native", **{"scene.objects.red.mass": 0.1, "actions.delay.params.steps": (0, 0)})
    assert env.physics_model.body("red").mass[0] == pytest.approx(0.1) and env.action_size == 3
    assert env.state_shape.info["carry"].memory["actions.delay"].past.shape == (0, 3)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 / 0\n", r"^cannot load .*guest.py: ZeroDivisionError: division by zero \(.*guest.py:1\)$"),
        ("1 +\n", r"^cannot load .*guest.py: SyntaxError: invalid syntax \(guest.py, line 1\)$"),
        ("import mjx_nero\nmjx_nero.register(envs={'nero_lift': (None, {'a': len})})\n", "there is already an env 'nero_lift'"),
        ("import mjx_nero\nmjx_nero.register(envs={'new': (None, {})})\n", "the environment 'new' has no preset"),
        (
            "import mjx_nero\nfrom mjx_nero.learn.learner import Kind\n"
            "mjx_nero.register(learners={'new': Kind(make=None, presets={'mine': 1}, policy=None)})\n",
            "the learner 'new' has no preset 'default'",
        ),
        ("import mjx_nero\nmjx_nero.register(controllers={'ik': (None, None)})\n", "there is already a controller 'ik'"),
        ("import mjx_nero\nmjx_nero.register(physics_backends={'jax': None})\n", "there is already a physics 'jax'"),
    ],
)
def test_what_a_guest_does_wrong_is_one_line(call, tmp_path, text, message):
    path = tmp_path / "guest.py"
    path.write_text(text)
    code, _, err = call("mjx_nero", "list-envs", "--load", path)
    assert code == 2 and err.count("\n") == 1
    assert re.search(message, err.removeprefix("error: ").strip())


def test_an_environment_without_a_preset_default_takes_its_first():
    robot, presets = registry.ENVS["nero_reach"]
    register(envs={"env_of_others": (robot, {"still": presets["isaac"], "moving": presets["default"]})})
    assert list_presets("env_of_others") == ("default", "still", "moving")
    assert env_cfg("env_of_others") == env_cfg("nero_reach", "isaac") != env_cfg("nero_reach")


def test_a_guest_that_is_not_there_is_one_line(call, tmp_path):
    (tmp_path / "my_code").mkdir()
    missing = (
        ("nowhere.py", "there is no file"),
        ("no_such_module", "ModuleNotFoundError"),
        ("my_code", "it is a folder"),
    )
    for name, what in missing:
        code, _, err = call("eval", "--load", name)
        assert code == 2 and err.startswith(f"error: cannot load {name}: {what}") and err.count("\n") == 1


def test_a_module_beside_the_user_and_an_entry_point_are_loaded(call, tmp_path, monkeypatch):
    text = "import mjx_nero\nfrom mjx_nero.tasks.arms import nero\nmjx_nero.register(envs={{'{0}': nero.ENVS['nero_reach']}})\n"
    (tmp_path / "beside_me.py").write_text(text.format("env_beside"))
    assert call("mjx_nero", "inspect", "--load", "beside_me", "nero")[0] == 0 and "env_beside" in list_envs()

    class Entry:
        name, value = "theirs", "their_package.tasks"

        def load(self):
            registry.add_env("env_of_a_package", *registry.ENVS["nero_reach"])

    monkeypatch.setattr(cli.metadata, "entry_points", lambda group: [Entry()] if group == "mjx_nero" else [])
    code, _, err = call("mjx_nero", "inspect", "nero")
    assert code == 0 and "env_of_a_package" in list_envs(), err


# --- a backend of a page


class Drift:
    """A physics in which drives are perfect and nothing else moves."""

    compiler_options: dict = {}

    def __init__(self, model: mujoco.MjModel, cfg, fields=()):
        self.model, self.period, self.prepared = model, cfg.dt * cfg.decimation, []
        self._at = model.jnt_qposadr[model.actuator_trnid[:, 0]]

    def step(self, sim: Sim, ctrl):
        """The joints are where they should be."""
        qpos = sim.qpos.at[..., self._at].set(ctrl)
        return sim.replace(qpos=qpos, ctrl=ctrl, time=sim.time + self.period), jnp.zeros(sim.time.shape)

    def prepare(self, num_envs, num_devices=1):
        """Nothing to do."""
        self.prepared.append((num_envs, num_devices))

    def footprint(self, num_devices=1):
        """A megabyte of its own, of which there are 20."""
        return Footprint(outside=2.0**20, free=20 * 2.0**20)


@pytest.fixture(scope="module")
def drift():
    register(physics_backends={"drift": Drift})
    return "drift"


def test_a_fake_backend_goes_through_reset_and_step(drift):
    env = make("nero_lift", preset="isaac", impl=drift)  # positions: half of an action is a target
    assert isinstance(env.physics, physics.Physics) and isinstance(env.physics, Drift) and env.backend == "drift"
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 4))
    action = jnp.full((4, 8), 0.02)
    after = jax.jit(jax.vmap(env.step))(state, action)
    assert jnp.allclose(after.pipeline_state.qpos[:, 0], 0.01) and not after.metrics["nan"].any()


def test_a_fake_backend_is_asked_for_its_memory(drift, call):
    flags = ("--impl", drift, "--num-envs", 64, "--num-timesteps", 1000)
    code, _, err = call("train", "--env", "nero_lift", *flags, "--ppo.unroll_length", 2, "--ppo.num_minibatches", 2)
    assert code == 2 and "64 environments need about 0.1 GB of memory on a device" in err and "pass --num-envs 16" in err


@pytest.mark.slow
def test_a_fake_backend_is_measured(drift, call, tmp_path):
    flags = ("--impl", drift, "--num-envs", 4, "--steps", 3, "--repeats", 1, "--what", "physics,step")
    code, out, err = call("mjx_nero", "benchmark", *flags, "--json", tmp_path / "rows.json")
    assert code == 0, err
    rows = json.loads((tmp_path / "rows.json").read_text())["rows"]
    assert [row["impl"] for row in rows] == [drift] * 2 and {row["warp_mb"] for row in rows} == {4.0}


def test_an_unknown_backend_is_one_line():
    with pytest.raises(UserError, match="unknown impl 'warq': choose one of auto, warp, jax, native"):
        make("nero_lift", impl="warq")
