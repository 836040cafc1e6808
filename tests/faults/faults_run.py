"""A training run of seconds, whose programs are compiled once for all tests, and readers of what it leaves."""

import dataclasses
import json

from safetensors.numpy import load

from mjx_nero.runs import compiled

FLAGS = ["--num-envs", 8, "--ppo.unroll_length", 4, "--ppo.num_minibatches", 2, "--ppo.num_epochs", 1]
FLAGS += ["--ppo.network.actor", "(8,)", "--ppo.network.critic", "(8,)", "--env.episode_length_s", 0.2, "--no-video"]
STEPS = 640  # ten chunks of two iterations of 32 env steps
CHUNK = 64

_learners: dict = {}
_fresh: dict = {}
_programs: dict = {}
_make, _Fresh, _compile = compiled.make_learner, compiled.Fresh, compiled.compile


def learner(run):
    key = repr((run.env_name, run.preset, run.learner, dataclasses.replace(run.hyperparameters, num_timesteps=0)))
    if key not in _learners:
        _learners[key] = _make(run)
    return _learners[key]


def fresh(learner, bank=None, programs=None):
    if id(learner) not in _fresh:
        _fresh[id(learner)] = _Fresh(learner, bank, programs)
    return _fresh[id(learner)]


def compile(run, learner, chunk, start, programs, trace, kernels):
    if (id(learner), chunk) not in _programs:
        _programs[id(learner), chunk] = _compile(run, learner, chunk, start, programs, trace)
    return dataclasses.replace(_programs[id(learner), chunk], state=start())


def last(run):
    """The newest checkpoint's bytes, without what it says of times."""
    newest = sorted((run / "checkpoints").glob("*.safetensors"))[-1]
    return newest.name, {name: x.tobytes() for name, x in load(newest.read_bytes()).items()}


def rows(run):
    """Its metrics; no number in them that JSON does not have."""

    def refuse(text):
        raise AssertionError(text)

    return [json.loads(line, parse_constant=refuse) for line in (run / "metrics.jsonl").read_text().splitlines()]
