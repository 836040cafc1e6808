"""Configs: dotted names, overrides, the recipe's numbers."""

import dataclasses
import json

import pytest

from mjx_nero import UserError, config, control, env_cfg, list_envs, list_presets, list_robots, make
from mjx_nero.config import bounds
from mjx_nero.envs.task import CurriculumCfg, EnvCfg
from mjx_nero.learn.ppo.cfg import NetworkCfg
from mjx_nero.learn.ppo.learner import PRESETS
from mjx_nero.mdp import actions
from mjx_nero.tasks import registry
from mjx_nero.tasks.arms.nero import NERO
from mjx_nero.tasks.usual import CALM, PRECISE, SHOWN


@dataclasses.dataclass(frozen=True)
class Inner:
    scale: float = 0.5
    steps: int = 3
    on: bool = True
    name: str = "one"


def double(x):
    return 2 * x


@dataclasses.dataclass(frozen=True)
class Outer:
    inner: Inner = Inner()
    box: tuple[float, float] = (0.0, 1.0)
    layers: tuple[int, ...] = (8, 4)
    terms: dict = dataclasses.field(default_factory=lambda: {"a": Inner(scale=2.0), "b": {"x": (1.0, 2.0)}})
    func: object = double
    nothing: object = None
    optional: float | None = 1.0
    nested: tuple[tuple[float, float], ...] = ((0.0, 1.0),)
    names: tuple[str, ...] = ()
    late: float = 0  # a whole number now, declared as any


CFG = Outer()


def test_flatten_lists_what_can_be_overridden():
    assert config.flatten(CFG) == {
        "inner.scale": 0.5,
        "inner.steps": 3,
        "inner.on": True,
        "inner.name": "one",
        "box": (0.0, 1.0),
        "layers": (8, 4),
        "terms.a.scale": 2.0,
        "terms.a.steps": 3,
        "terms.a.on": True,
        "terms.a.name": "one",
        "terms.b.x": (1.0, 2.0),
        "nothing": None,
        "optional": 1.0,
        "nested": ((0.0, 1.0),),
        "names": (),
        "late": 0,
    }


def test_to_dict_is_json():
    as_dict = config.to_dict(CFG)
    assert as_dict["terms"] == {"a": {"scale": 2.0, "steps": 3, "on": True, "name": "one"}, "b": {"x": [1.0, 2.0]}}
    assert as_dict["box"] == [0.0, 1.0] and as_dict["layers"] == [8, 4] and as_dict["func"].endswith("test_config.double")
    assert json.loads(json.dumps(as_dict)) == as_dict
    task = config.to_dict(env_cfg("nero_lift"))
    assert json.loads(json.dumps(task)) == task
    assert task["rewards"]["reaching_object"]["func"] == "mjx_nero.mdp.rewards.object_ee_distance"


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("inner.scale", 0.25, 0.25),
        ("inner.scale", "0.25", 0.25),
        ("inner.scale", 2, 2.0),
        ("inner.scale", "2", 2.0),
        ("inner.scale", "1e-3", 0.001),
        ("inner.steps", "7", 7),
        ("inner.on", "false", False),
        ("inner.on", " True ", True),
        ("inner.on", False, False),
        ("inner.name", "3", "3"),
        ("box", "(2, 3.5)", (2.0, 3.5)),
        ("box", "2, 3.5", (2.0, 3.5)),
        ("box", [2, 3], (2.0, 3.0)),
        ("layers", "(16, 16)", (16, 16)),
        ("layers", "(16, 16, 16)", (16, 16, 16)),
        ("layers", (32,), (32,)),
        ("terms.a.scale", "4", 4.0),
        ("terms.b.x", "-1, 1", (-1.0, 1.0)),
        ("layers", "()", ()),
        ("layers", "[8,]", (8,)),
        ("layers", "8", (8,)),
        ("inner.scale", ".5", 0.5),
        ("inner.scale", "+1.E2", 100.0),
        ("inner.steps", "1e6", 1_000_000),
        ("optional", "3", 3.0),
        ("optional", "None", None),
        ("optional", 2, 2.0),
        ("nested", "((1, 2), (3, 4))", ((1.0, 2.0), (3.0, 4.0))),
        ("nested", "(1, 2), (3, 4)", ((1.0, 2.0), (3.0, 4.0))),
        ("names", "('a_1', b)", ("a_1", "b")),
        ("late", "3", 3.0),
        ("nothing", "5", 5),
        ("nothing", "(1, (true, x))", (1, (True, "x"))),
    ],
)
def test_override(name, value, expected):
    before = config.flatten(CFG)
    changed = config.override(CFG, {name: value})
    new = config.flatten(changed)[name]
    assert new == expected and type(new) is type(expected)
    if isinstance(expected, tuple):
        assert [type(x) for x in new] == [type(x) for x in expected]
    assert config.flatten(changed) == {**before, name: expected}  # nothing else changed
    assert config.flatten(CFG) == before


def test_every_field_that_help_lists_can_be_set():
    """Those of ``training``, too, whose names are the learner's dotted ones."""
    cfg = env_cfg("nero_lift")
    before = config.flatten(cfg)
    for name, value in before.items():
        assert config.flatten(config.override(cfg, {name: value})) == before, name
    assert config.override(cfg, {"training.network.init_std": "0.3"}).training["network.init_std"] == 0.3


def test_several_overrides_at_once():
    changed = config.override(CFG, {"inner.scale": 1.0, "inner.steps": 9})
    assert changed.inner == Inner(scale=1.0, steps=9)


def test_a_group_is_replaced_by_one_of_its_kind():
    assert config.override(CFG, {"inner": Inner(steps=1)}).inner.steps == 1
    with pytest.raises(UserError, match="inner takes Inner: pass one, or set its fields singly"):
        config.override(CFG, {"inner": 3})
    with pytest.raises(UserError, match="inner takes Inner: pass one"):
        config.override(CFG, {"inner": "3"})


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("inner.scal", r"no field 'inner.scal': 'scal' is not one of scale, steps, on, name \(did you mean 'scale'\?\)"),
        (
            "iner.scale",
            r"'iner' is not one of inner, box, layers, terms, func, nothing, .* \(did you mean 'inner'\?\)",
        ),
        ("terms.c.scale", r"no field 'terms.c.scale': 'c' is not one of a, b"),
        ("box.x", r"no field 'box.x': 'x' is not one of no fields"),
        ("zzz", r"'zzz' is not one of inner, box, layers, terms, func, nothing, optional, nested, names, late$"),
        ("", r"no field ''"),
    ],
)
def test_misspelt_names(name, message):
    with pytest.raises(UserError, match=message):
        config.override(CFG, {name: 1})


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("inner.scale", "fast", r"inner.scale takes a finite number, got 'fast'"),
        ("inner.scale", True, r"inner.scale takes a finite number, got True"),
        ("inner.scale", "(1, 2)", r"inner.scale takes a finite number, got '\(1, 2\)'"),
        ("inner.scale", "__import__('os').getcwd()", r"inner.scale takes a finite number, got \"__import__"),
        ("inner.scale", "1_0", r"inner.scale takes a finite number, got '1_0'"),
        ("inner.scale", "0x10", r"inner.scale takes a finite number, got '0x10'"),
        ("inner.scale", "1e999", r"inner.scale takes a finite number, got '1e999'"),
        ("inner.scale", "nan", r"inner.scale takes a finite number, got 'nan'"),
        ("inner.scale", float("nan"), r"inner.scale takes a finite number, got nan"),
        ("inner.scale", float("inf"), r"inner.scale takes a finite number, got inf"),
        ("inner.scale", "9" * 400, r"inner.scale takes a finite number, got '9{10,30}\.\.\.9{10,30}'$"),
        ("inner.scale", 10**400, r"inner.scale takes a finite number, got 10{10,30}\.\.\.0{10,30}$"),
        ("inner.scale", [10**5000], r"inner.scale takes a finite number, got list too long to show$"),
        ("inner.scale", [[[[0] * 99] * 99] * 99] * 99, r"inner.scale takes a finite number, got \[\[\[\.\.\.\]"),
        ("inner.steps", 1.5, r"inner.steps takes a whole number, got 1.5"),
        ("inner.steps", "1.5", r"inner.steps takes a whole number, got '1.5'"),
        ("inner.steps", "1_000", r"inner.steps takes a whole number, got '1_000'"),
        ("inner.steps", "1e12345", r"inner.steps takes a whole number, got '1e12345'"),
        ("inner.steps", 2**64, r"inner.steps takes a whole number, got 18446744073709551616"),
        ("inner.steps", True, r"inner.steps takes a whole number, got True"),
        ("inner.on", 1, r"inner.on takes true or false, got 1"),
        ("inner.on", "1", r"inner.on takes true or false, got '1'"),
        ("inner.name", 3, r"inner.name takes a name, got 3"),
        ("box", "(1, 'a')", r"box\[1\] takes a finite number, got 'a'"),
        ("box", "3", r"box takes a list of 2 numbers, got '3'"),
        ("box", "(3, 4", r"box takes a list of 2 numbers, got '\(3, 4'"),
        ("box", "3, 4)", r"box takes a list of 2 numbers, got '3, 4\)'"),
        ("box", "(" * 9999, r"box takes a list of 2 numbers, got '\(+\.\.\.\(+'"),
        ("box", (1.0, 2.0, 3.0), r"box takes a list of 2 numbers, got \(1.0, 2.0, 3.0\)"),
        ("layers", "(8, 4.5)", r"layers\[1\] takes a whole number, got '4.5'"),
    ],
)
def test_wrong_values(name, value, message):
    with pytest.raises(UserError, match=message):
        config.override(CFG, {name: value})


def test_task_overrides_by_dotted_name():
    overrides = {"rewards.reaching_object.params.std": "0.2", "scene.objects.cube.mass": 0.1, "robot.arm.speed": (3,) * 7}
    cfg = env_cfg("nero_lift", **overrides)
    assert cfg.rewards["reaching_object"].params == {"std": 0.2, "object": "cube"}
    assert cfg.scene.objects["cube"].mass == 0.1 and cfg.robot.arm.speed == (3.0,) * 7
    fresh = env_cfg("nero_lift")
    assert fresh.rewards["reaching_object"].params == {"std": 0.1, "object": "cube"}
    assert fresh.scene.objects["cube"].mass == 0.03 and NERO.arm.speed == (1.5,) * 7
    with pytest.raises(UserError, match=r"'stdd' is not one of std, object \(did you mean 'std'\?\)"):
        env_cfg("nero_lift", **{"rewards.reaching_object.params.stdd": 1.0})


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: env_cfg("nero_lif"), r"unknown env 'nero_lif' \(did you mean 'nero_lift'\?\): choose one of \d+, such as nero_"),
        (lambda: env_cfg("nero_lift", "isac"), r"unknown preset of nero_lift 'isac' \(did you mean 'isaac'\?\): choose one of"),
        (lambda: list_presets("x"), r"^unknown env 'x': choose one of \d+, such as (\w+, ){5}\w+$"),
        (lambda: make("nero_lift", impl="cuda"), r"unknown impl 'cuda': choose one of auto, warp, jax, native"),
    ],
)
def test_unknown_names(call, message):
    with pytest.raises(UserError, match=message):
        call()


def test_registry_lists():
    everywhere = {f"{robot}_{task}" for robot in ("nero", "cobotta", "piper", "so100", "so101") for task in ("lift", "reach")}
    more = ("follow_target", "pick_place", "place", "stack", "clutter", "lift_any", "push", "reach_obstacles", "lift_obstacles")
    more += ("open_drawer", "open_door", "turn_knob", "insert_peg", "hang_ring")
    controlled = {f"{robot}_{task}" for robot in ("nero", "cobotta") for task in more[:2]}
    everywhere |= {f"{robot}_{task}" for robot in ("nero", "cobotta", "piper", "so100", "so101") for task in more[2:]}
    everywhere |= {f"{robot}_reorient" for robot in ("nero", "cobotta", "piper")}
    everywhere |= {"nero_handover", "nero_cobotta_handover"}
    assert set(list_envs()) == everywhere | controlled | {"reach", "lift", "reorient", "handover", *more}
    assert set(list_robots()) == {"nero", "cobotta_pro_900", "piper", "so_arm100", "so_arm101"}
    assert list_presets("nero_lift")[0] == "default" and "isaac" in list_presets("nero_lift")
    assert list_presets("cobotta_follow_target") == ("default", "static")


@pytest.mark.parametrize("name", [name for name in list_envs() if registry.robot_of(name)])
def test_every_environment_has_a_config_that_fits(name):
    for preset in list_presets(name):
        cfg = env_cfg(name, preset)
        assert json.loads(json.dumps(config.to_dict(cfg)))["robot"]["name"] == cfg.robot.name
        assert set(cfg.controllers) <= set(control.CONTROLLERS)
        # What takes drive targets is for controllers, and their fields are those of their configs.
        assert "drives" not in cfg.actions or cfg.controllers
        for controller, fields in cfg.controllers.items():
            config.override(control.CONTROLLERS[controller][1], fields)
        env, robots = make(name, preset, impl="jax"), (cfg.robot, *cfg.scene.robots.values())
        arms = sum(len(robot.arm.joints) + ("gripper" in cfg.actions) for robot in robots)
        assert env.action_size == (env.physics_model.nu if "drives" in cfg.actions else arms)


def test_drives_are_given_joint_by_joint():
    for robot in map(registry.robot, list_robots()):
        for drive in (robot.arm, robot.gripper):
            fields = (drive.stiffness, drive.damping, drive.effort, drive.speed, drive.home)
            assert {len(values) for values in fields} == {len(drive.joints)}
        assert robot.arm.lead == tuple(d / k for d, k in zip(robot.arm.damping, robot.arm.stiffness, strict=True))
        assert len(robot.gripper.open) == len(robot.gripper.close) == len(robot.gripper.joints)


@pytest.mark.parametrize("preset", ["default", "isaac"])
def test_factories_return_equal_but_fresh_configs(preset):
    a, b = env_cfg("nero_lift", preset), env_cfg("nero_lift", preset)
    assert a == b and a is not b
    assert a.rewards is not b.rewards and a.observations is not b.observations and a.terminations is not b.terminations
    with pytest.raises(TypeError, match="does not support item deletion"):
        del a.rewards["reaching_object"]


def test_params_are_not_shared_between_configs():
    for preset in ("default", "isaac"):
        a, b = env_cfg("nero_lift", preset), env_cfg("nero_lift", preset)
        for name in a.rewards:
            if a.rewards[name].params:
                assert a.rewards[name].params is not b.rewards[name].params, (preset, name)


def test_configs_are_frozen():
    with pytest.raises(dataclasses.FrozenInstanceError):
        env_cfg("nero_lift").episode_length_s = 1.0


def test_curriculum_must_name_a_reward():
    cfg = env_cfg("nero_lift", "isaac")
    with pytest.raises(UserError, match="curriculum.weights names speed: not one of reaching_object, lifting_object"):
        dataclasses.replace(cfg, curriculum=CurriculumCfg({"speed": cfg.curriculum.weights["joint_vel"]}))


# The recipe, number by number: (function of the package, weight, parameters).
CUBE = {"object": "cube"}
RECIPE_REWARDS = {
    "reaching_object": ("object_ee_distance", 1.0, {"std": 0.05, **CUBE}),
    "lifting_object": ("object_is_lifted", 15.0, {"minimal_height": 0.025, **CUBE}),
    "object_goal_tracking": ("object_goal_distance", 16.0, {"std": 0.3, "minimal_height": 0.025, **CUBE}),
    "object_goal_tracking_fine_grained": ("object_goal_distance", 5.0, {"std": 0.05, "minimal_height": 0.025, **CUBE}),
    "action_rate": ("action_rate_l2", -1e-4, {}),
    "joint_vel": ("joint_vel_l2", -1e-4, {}),
}
RECIPE_OBSERVATIONS = ["joint_pos_rel", "joint_vel_rel", "object_position", "command", "last_action"]


def test_isaac_preset_is_the_recipe():
    cfg: EnvCfg = env_cfg("nero_lift", "isaac")
    assert {n: (t.func.__name__, t.weight, t.params) for n, t in cfg.rewards.items()} == RECIPE_REWARDS
    assert {n: (t.func.__name__, t.params) for n, t in cfg.curriculum.weights.items()} == {
        "action_rate": ("step_weight", {"to": -1e-1, "num_steps": 10_000}),
        "joint_vel": ("step_weight", {"to": -1e-1, "num_steps": 10_000}),
    }
    assert list(cfg.observations) == ["state"]
    assert [t.func.__name__ for t in cfg.observations["state"].terms.values()] == RECIPE_OBSERVATIONS
    assert all(t.noise == 0 for t in cfg.observations["state"].terms.values())
    assert cfg.command.func.__name__ == "uniform_position" and cfg.command.resample_s == 5.0
    assert cfg.command.params == {"x": (0.3, 0.35), "y": (-0.2, 0.2), "z": (0.2, 0.35)}
    (event,) = cfg.events.values()
    assert event.func.__name__ == "object_position_uniform"
    # The recipe's cubes: (0.2, 0, 0.015) and an offset of 0.1 to 0.2, -0.1 to 0.2, 0. Here the offset counts from the robot.
    assert event.params == {"x": (0.3, 0.4), "y": (-0.1, 0.2), "z": (0.0, 0.0), **CUBE}
    assert cfg.scene.objects["cube"].rest_height == 0.015 and cfg.scene.objects["cube"].size == (0.03, 0.03, 0.03)
    assert (cfg.sim.dt, cfg.sim.decimation, cfg.episode_length_s) == (0.01, 2, 5.0)
    assert cfg.actions["arm"].params["scale"] == 0.5 and cfg.action_clip == 0.0
    done = {n: (t.func.__name__, t.params, t.time_out) for n, t in cfg.terminations.items()}
    assert done.pop("time_out") == ("time_out", {}, True)
    assert done.pop("object_dropping") == ("object_below", {"minimum_height": -0.05, **CUBE}, False)
    # Not in the recipe: stands for the fall from its table, whose edges the physics' plane has not.
    assert done.pop("object_off_table") == ("object_off_table", {"center": (0.3, 0.0), "size": (1.0, 1.2), **CUBE}, False)
    assert not done


def test_drives_are_the_recipe():
    arm, gripper = NERO.arm, NERO.gripper
    assert arm.joints == tuple(f"joint{i}" for i in range(1, 8))
    assert arm.stiffness == (200, 170, 120, 80, 50, 20, 10)
    assert arm.damping == (100, 60, 70, 24, 20, 10, 5)
    assert (arm.effort, arm.speed) == ((25,) * 7, (1.5,) * 7)
    assert arm.home == (0, 0, 0, 2.0, 0, 0, 0)
    assert gripper.joints == ("gripper_joint1", "gripper_joint2")
    assert gripper.stiffness == (800, 800) and gripper.damping == (20, 20)
    assert (gripper.effort, gripper.speed) == ((22, 22), (1.5, 1.5))
    assert gripper.home == gripper.open == (0.05, -0.05) and gripper.close == (0, -0.001)
    assert NERO.base_quat == (0, 0, 0, 1) and NERO.base_pos == (0, 0, 0)
    assert NERO.joints == arm.joints + gripper.joints and NERO.home == arm.home + gripper.home


def test_drives_reach_the_model(env):
    model = env.physics_model
    for i, name in enumerate(NERO.joints):
        drive, k = (NERO.arm, i) if i < 7 else (NERO.gripper, i - 7)
        actuator = model.actuator(i)
        assert model.joint(actuator.trnid[0]).name == name
        assert actuator.gainprm[0] == drive.stiffness[k]
        assert tuple(actuator.biasprm[:3]) == (0, -drive.stiffness[k], -drive.damping[k])
        assert tuple(actuator.forcerange) == (-drive.effort[k], drive.effort[k]) and actuator.forcelimited[0]
        assert tuple(actuator.ctrlrange) == tuple(model.joint(name).range) and actuator.ctrllimited[0]
    assert model.nu == 9 and model.opt.timestep == 0.01


def test_runner_settings_are_the_recipe():
    want = {
        "unroll_length": 24,
        "num_epochs": 5,
        "num_minibatches": 4,
        "learning_rate": 1e-4,
        "desired_kl": 0.01,
        "clipping": 0.2,
        "entropy_cost": 0.006,
        "discounting": 0.98,
        "gae_lambda": 0.95,
        "max_grad_norm": 1.0,
        "value_loss": 1.0,
        "clip_value": 0.2,
        # What the recipe does not have.
        "normalize_returns": False,
        "min_std": 0.0,
        "max_std": 0.0,
    }
    assert {name: getattr(PRESETS["isaac"], name) for name in want} == want
    assert PRESETS["isaac"].network == NetworkCfg(
        actor=(256, 128, 64),
        critic=(256, 128, 64),
        activation="elu",
        distribution="normal",
        init_std=1.0,
        output_scale=1.0,
        max_observation=0.0,
    )


def test_one_learner_is_for_all_tasks_and_arms():
    """But for how long it takes, velocities, what bears no noise, what an expert shows, and presets of recipes."""
    for env in registry.list_envs():
        cfg = registry.env_cfg(env, registry.list_presets(env)[0], registry.robot_of(env) or "nero")
        moves = any(bounds.unwrapped(term.func) is actions.JointVelocity for term in cfg.actions.values())
        taught = env.endswith(("lift", "place", "stack", "clutter", "lift_obstacles"))
        taught |= env.endswith(("insert_peg", "hang_ring", "reorient", "handover"))
        shown = taught and not env.endswith("pick_place")
        calm = SHOWN if shown else CALM if moves else {}
        if env.endswith("clutter"):
            calm = {**SHOWN, "averaging": 0.9}
        if env.endswith(("hang_ring", "handover", "insert_peg")):
            calm = {**PRECISE, **({"max_std": 0.15} if env.endswith("insert_peg") else {})}
        assert {k: v for k, v in cfg.training.items() if k != "num_timesteps"} == calm, env
    assert registry.env_cfg("nero_reach", "isaac").training["num_epochs"] == 8


@pytest.mark.parametrize(
    ("make_cfg", "message"),
    [
        (lambda: NetworkCfg(activation="gelu"), "unknown activation 'gelu': choose one of elu, swish, relu, tanh"),
        (lambda: NetworkCfg(distribution="beta"), "unknown distribution 'beta': choose normal or tanh_normal"),
    ],
)
def test_bad_hyperparameters(make_cfg, message):
    with pytest.raises(UserError, match=message):
        make_cfg()
