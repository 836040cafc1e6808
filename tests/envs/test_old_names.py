"""Fields of version 0.5.0 by the names that they had: on command lines, in scripts, and in the config.json of a run."""

import pytest

from mjx_nero import UserError, config, env_cfg
from mjx_nero.runs import resume


def groups(cfg, field):
    return {name: getattr(group, field) for name, group in cfg.observations.items()}


def test_fields_of_groups():
    plain = env_cfg("nero_lift")
    assert groups(plain, "corruption") == {"state": True, "privileged_state": True}
    assert env_cfg("nero_lift", corruption="false") == plain.uncorrupted() != plain
    assert groups(env_cfg("nero_lift", apart=("privileged_state",)), "apart") == {"state": False, "privileged_state": True}
    assert groups(env_cfg("nero_lift", sensed="state, privileged_state"), "sensed") == {"state": True, "privileged_state": True}


@pytest.mark.parametrize(
    ("env", "preset", "old", "new", "value"),
    [
        ("nero_lift", "default", "observations.state.joint_pos.noise", "observations.state.terms.joint_pos.noise", 0.5),
        ("nero_lift", "sim2real", "widening.params.up", "curriculum.levels.params.up", 0.5),
        ("nero_lift", "isaac", "curriculum.joint_vel.params.to", "curriculum.weights.joint_vel.params.to", -0.5),
        ("nero_lift", "isaac", "curriculum", "curriculum.weights", {}),
        ("nero_follow_target", "default", "motion.params.radius", "command.motion.params.radius", 0.5),
        ("nero_push", "default", "training.num_timesteps", "budget.steps", 5_000_000),
        ("nero_clutter", "default", "targets", "command.targets", ("pill", "capsule", "sphere", "cylinder", "bar", "box")),
    ],
)
def test_moved_fields(env, preset, old, new, value):
    cfg = env_cfg(env, preset, **{old: value})
    assert cfg != env_cfg(env, preset)
    assert cfg == env_cfg(env, preset, **{new: value})


def test_what_is_wrong_is_said_by_the_new_name():
    with pytest.raises(UserError, match=r"^observations.state.terms.joint_pos.noise must be at least 0, got '-1'"):
        env_cfg("nero_lift", **{"observations.state.joint_pos.noise": "-1"})
    with pytest.raises(UserError, match="'joint_poss' is not one of joint_pos, joint_vel"):
        env_cfg("nero_lift", **{"observations.state.joint_poss.noise": 0.1})


def as_version_0_5_0(cfg):
    """What ``config.json`` said of a task in version 0.5.0."""
    new = config.to_dict(cfg)
    command, curriculum, observed = new.pop("command"), new.pop("curriculum"), new.pop("observations")
    return {
        **new,
        "command": {name: command[name] for name in ("func", "params", "resample_s")},
        "motion": command["motion"],
        "targets": command["targets"],
        "curriculum": curriculum["weights"],
        "widening": curriculum["levels"],
        "observations": {name: group["terms"] for name, group in observed.items()},
        "corruption": all(group["corruption"] for group in observed.values()),
        "apart": [name for name, group in observed.items() if group["apart"]],
        "sensed": [name for name, group in observed.items() if group["sensed"]],
    }


@pytest.mark.parametrize(
    ("env", "preset"),
    [("nero_lift", "sim2real"), ("nero_lift", "isaac"), ("nero_clutter", "four"), ("nero_follow_target", "default")],
)
def test_the_config_of_a_run(env, preset):
    ours = env_cfg(env, preset)
    assert resume._as_stored(ours, as_version_0_5_0(ours)) == ours
    own = {"observations.state.corruption": False, **{name: 0.125 for name in config.flatten(ours) if name.endswith(".noise")}}
    own |= {"curriculum.levels.params.up": 0.5} if preset == "sim2real" else {}
    theirs = env_cfg(env, preset, **own).uncorrupted()
    assert resume._as_stored(ours, as_version_0_5_0(theirs)) == theirs != ours
