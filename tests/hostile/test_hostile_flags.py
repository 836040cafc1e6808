"""Flags beyond reason: one line, and no folder left."""

import functools

import bad_files as bad
import pytest
import urdf_files as make

TRAIN = "train --env nero_reach --num-envs 8 --num-timesteps 1000 --no-video --out run"
EVAL = "eval --env nero_reach --episodes 1"
FLAGS = {
    "1e999 environments": f"{TRAIN} --num-envs 1e999",
    "infinite steps": f"{TRAIN} --num-timesteps inf",
    "NaN steps": f"{TRAIN} --num-timesteps nan",
    "400 digits": f"{TRAIN} --num-timesteps {'9' * 400}",
    "400 digits of a field": f"{TRAIN} --ppo.num_timesteps {'9' * 400}",
    "5000 digits of a field": f"{TRAIN} --ppo.num_timesteps {'9' * 5000}",
    "deep field": f"{TRAIN} --env.sim.dt {'(' * 500}",
    "seed": f"{TRAIN} --seed {2**64}",
    "negative seed": f"{TRAIN} --seed -{2**63}0",
    "seed of an evaluation": f"{EVAL} --seed {10**30}",
    "long out": f"{TRAIN} --out {'x' * 300}",
    "long out of an import": f"import-urdf in/robot.urdf --out {'x' * 300}",
    "long path": f"import-urdf in/robot.urdf --out {'x/' * 4000}",
    "long robot": f"inspect {'x' * 300}",
    "long policy": f"{EVAL} --policy {'x' * 300}",
    "long video": f"{EVAL} --video {'x' * 300}.mp4",
    "negative minibatches": f"{TRAIN} --ppo.num_minibatches -8",
    "no unroll": f"{TRAIN} --ppo.unroll_length 0",
    "no epochs": f"{TRAIN} --ppo.num_epochs 0",
    "NaN minutes": f"{TRAIN} --max-minutes nan",
    "infinite minutes": f"{TRAIN} --max-minutes inf",
    "negative minutes": f"{TRAIN} --max-minutes -1",
    "negative rate": f"{TRAIN} --ppo.learning_rate -1e-3",
    "infinite rate": f"{TRAIN} --ppo.learning_rate 1e999",
    "NaN discount": f"{TRAIN} --ppo.discounting nan",
    "20,000 layers": f"{TRAIN} --ppo.network.actor ({'64,' * 20_000})",
    "wide layer": f"{TRAIN} --ppo.network.actor (1000000000,)",
    "no precision": f"{TRAIN} --ppo.matmul_precision sloppy",
    "video of no kind": f"{EVAL} --video v.zzz",
    "1e12 episodes": f"{EVAL} --episodes 1e12",
    "half an episode": f"{EVAL} --episodes 0.5",
    "a field called as an argument of a function": f"{TRAIN} --env.robot none",
    "another one": f"{TRAIN} --env.preset default",
    "robot of another folder": f"{EVAL} --env.robot.name ../../../etc",
    "robot without a name": f"{EVAL} --env.robot.name=",
    "fewer joints than gains": f"{EVAL} --env.robot.arm.joints (joint1,)",
    "a joint twice": f"{EVAL} --env.robot.gripper.joints (joint1,joint2)",
    "home out of a joint's range": f"{EVAL} --env.robot.arm.home (9,0,0,0,0,0,0)",
    "negative opening": f"{EVAL} --env.robot.opening -1",
    "no way down": f"{EVAL} --env.robot.down (0,0,0,0)",
    "a policy and another agent": f"{EVAL} --policy p --agent zero",
    "a scale of no object": "inspect nero --scale 2",
    "a folder for a policy": f"{EVAL} --policy .",
    "a video of what is only shown": f"{EVAL} --view --video v.mp4",
}
EMPTY = (
    *(f"train --env nero_reach --{flag}" for flag in ("robot", "object", "learner", "restore", "seeds", "out")),
    *(f"eval --env nero_reach --{flag}" for flag in ("policy", "controller", "impl", "json")),
    *("inspect", "export --out p.onnx", "demos --env nero_reach --task"),
)


@pytest.mark.parametrize("start", EMPTY)
def test_an_empty_value_is_not_the_default(refuse, start):
    """A shell makes one of a variable that is not set: --robot "$ROBOT"."""
    assert "got an empty value" in refuse(lambda folder: [*start.split(), ""])
    if start.startswith(("train", "eval")):
        assert "got an empty value" in refuse(lambda folder: f"{start}=".split())


@pytest.mark.parametrize("name", FLAGS)
def test_refused(refuse, name):
    def case(folder):
        make.write(folder / "work" / "in", make.arm(2))
        return FLAGS[name].split()

    refuse(case)


def test_numbers_of_python(refuse):
    """Python reads 1_0 as ten; in a URDF it is no number."""
    line = refuse(functools.partial(bad.urdf, text=make.arm(2).replace('xyz="0 0 0.2"', 'xyz="1_0 0 0"', 1)))
    assert "is not numbers" in line
