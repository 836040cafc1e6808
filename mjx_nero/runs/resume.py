"""Resuming: the same run from its newest intact checkpoint, or a new run from a checkpoint or a policy."""

import dataclasses
import pathlib
from collections.abc import Callable, Collection, Iterator, Mapping
from typing import Any

import jax

from mjx_nero import config, files
from mjx_nero.config import values
from mjx_nero.errors import UserError
from mjx_nero.learn import checkpoint, header, learner
from mjx_nero.learn.learner import state_shape
from mjx_nero.learn.policy import checkpoint_policy
from mjx_nero.runs import checkpoints, compiled
from mjx_nero.runs import trust as trust_of
from mjx_nero.runs.cfg import Asked, RunCfg, resolve
from mjx_nero.runs.folder import CONFIG
from mjx_nero.sim import fixtures
from mjx_nero.tasks import registry

# Fields of a run's environment that name files, which may lie outside the run's folder.
_PATHS = ("identified", "object.file", "robot.folder", "robot.name", "robot.mjcf")
_MESHES = ("file", "bank")  # last parts of the names of an object's fields that name files, too
# Fields that a resumed run may change (its length, machine and outputs), and all fields that its config stores.
_FREE = config.marked(RunCfg, "free")
_OWN = (*_FREE, *config.marked(RunCfg, "kept"))


@dataclasses.dataclass(frozen=True)
class Source:
    """A file to resume from, and its description."""

    path: pathlib.Path
    meta: dict[str, Any]

    @property
    def is_checkpoint(self) -> bool:
        """True for a run's whole state; False for a policy, from which a new run takes only the networks."""
        return self.meta.get("kind") == "checkpoint"


def find(restore: pathlib.Path, warn: Callable[[str], None]) -> Source:
    """Finds the newest intact checkpoint of a run folder; a file is returned as it is.

    Raises:
        UserError: the folder holds no checkpoint.
    """
    if not restore.is_dir():
        return Source(restore, checkpoint.load_meta(restore))
    for path in checkpoints.saved(restore):
        try:
            checkpoint.verify(path)
            return Source(path, checkpoint.load_meta(path))
        except checkpoint.Damaged:
            warn(f"warning: {path} is damaged: using the checkpoint before it")
    raise UserError(f"{restore} holds no checkpoint to restore: give a run folder or a .safetensors file")


def same_run(
    folder: pathlib.Path, asked: RunCfg, flags: Collection[str], dotted: Mapping[str, Mapping[str, Any]], trust: bool = False
) -> RunCfg:
    """Rebuilds the run of a folder to resume it unchanged. The user may only change its length, its machine and its outputs.

    Args:
        asked: the run that the command line describes.
        flags: names of the flags that the user passed.
        dotted: the dotted flags, by prefix.
        trust: the user vouches for the run, so files that it names outside its folder may be read.

    Raises:
        UserError: a flag differs from the run's own; or the config is damaged, names untrusted files outside the folder, or
            comes from a version that this one cannot continue.
    """
    run = _rebuilt(folder, trust)
    if run is None:  # a version that stored too little
        return dataclasses.replace(asked, restore=folder, out=folder)

    def refuse(flag: str, own: Any, other: Any) -> None:
        if own != other:
            raise UserError(
                f"--{flag} is {other}, but {folder} is a run with {own}: leave the flag out to resume that run, or start a "
                "new one with another --out"
            )

    for flag, name in (("env", "env_name"), ("preset", "preset"), ("learner", "learner"), ("seed", "seed")):
        if flag in flags:
            refuse(flag, getattr(run, name), getattr(asked, name))
    if "robot" in flags:
        refuse("robot", run.asked.robot, asked.asked.robot)
    if "num_envs" in flags:
        refuse("num-envs", run.num_envs, asked.num_envs)
    for prefix, own in (("env", run.env), (run.learner, run.hyperparameters)):
        fields = config.current(own, dotted.get(prefix, {}))
        changed = config.flatten(config.override(own, fields))
        for name in fields:
            if name != "num_timesteps":
                refuse(f"{prefix}.{name}", config.flatten(own)[name], changed[name])
    changes: dict[str, Any] = {name: getattr(asked, name) for name in (*_FREE, "track") if name in flags}
    if "num_timesteps" in flags or "num_timesteps" in dotted.get(run.learner, {}):
        changes["hyperparameters"] = dataclasses.replace(run.hyperparameters, num_timesteps=asked.num_timesteps)
    return dataclasses.replace(run, **changes, restore=folder, out=folder)


def overridden(folder: pathlib.Path, run: RunCfg) -> str:
    """Describes, for people, what a resumed run does differently from before; empty if nothing."""
    before = _rebuilt(folder, trust=True)  # trust was checked before
    if before is None:
        return ""
    pairs = [(name, getattr(before, name), getattr(run, name)) for name in ("num_timesteps", *_FREE)]
    return ", ".join(f"{name} {new} instead of {old}" for name, old, new in pairs if old != new)


@dataclasses.dataclass(frozen=True)
class _Stored:
    """The parts of ``config.json`` from which a run is rebuilt."""

    env_name: str
    preset: str
    learner: str
    asked: Asked
    env: Mapping[str, Any]
    hyperparameters: Mapping[str, Any]
    versions: Mapping[str, str]


def _rebuilt(folder: pathlib.Path, trust: bool) -> RunCfg | None:
    """Rebuilds the run that ``config.json`` describes; None if its version stored too little.

    Raises:
        UserError: see ``same_run``.
    """
    path = files.inside(folder, CONFIG)
    found = files.read_json(path)
    if isinstance(found, dict) and "asked" not in found:
        return None
    try:
        named = {field.name for field in dataclasses.fields(_Stored)}
        stored = values.read(_Stored, {k: v for k, v in found.items() if k in named}, "")
        kinds = values.hints(RunCfg)
        own = {name: values.read(kinds[name], found[name], name) for name in _OWN}
    except (UserError, AttributeError, KeyError) as error:
        why = error if isinstance(error, UserError) else "fields are missing"
        raise UserError(
            f"{path} is damaged ({why}): pass --restore with a checkpoint, all flags of the run and another --out"
        ) from None
    trust_of.ask(folder, _outside(stored.asked), trust)
    try:
        asked = stored.asked
        run = resolve(stored.env_name, stored.preset, asked.robot, asked.env, {}, learner=stored.learner, **own)
        run = dataclasses.replace(run, asked=dataclasses.replace(run.asked, learner=asked.learner))
        fields = {"env": _as_stored(run.env, stored.env)}
        fields["hyperparameters"] = _as_stored(run.hyperparameters, stored.hyperparameters)
        return dataclasses.replace(run, **fields)
    except UserError as error:
        version = values.short(stored.versions.get("mjx-nero", "unknown"))[1:-1]
        raise UserError(f"{path} is a run of version {version}, which this version cannot resume: {error}") from None


def _outside(asked: Asked) -> Iterator[str]:
    """Yields the files that a run names outside its folder."""
    if asked.robot is not None and asked.robot not in registry.list_robots():
        yield asked.robot
    for name, value in asked.env.items():
        if _names_file(name) and value and value not in fixtures.own():
            yield str(value)
    if asked.learner.get("teacher"):
        yield str(asked.learner["teacher"])


def _names_file(field: str) -> bool:
    """True if a field of an environment's config, given by its dotted name, is the path of a file or folder."""
    last = field.rpartition(".")[2]
    if field.startswith("scene.objects.") and last in _MESHES:
        return True
    return field in _PATHS or field.startswith(("scene.fixtures.", "controllers.")) and last == "file"


def _as_stored(cfg: Any, stored: Any) -> Any:
    """Restores the values that the run began with if this version has others, except the files that it reads."""
    was = config.current(cfg, config.flatten(stored))
    now = config.flatten(config.to_dict(cfg))
    own = [name for name in config.flatten(cfg) if name in was and not _names_file(name)]
    return config.override(cfg, {name: was[name] for name in own if was[name] != now.get(name)})


def check(source: Source, meta: dict[str, Any]) -> None:
    """Checks that a file fits a run.

    Args:
        meta: description in the run's own checkpoints (``policy.describe``).

    Raises:
        UserError: the file does not fit; the message says why.
    """
    path, there = source.path, source.meta
    header.check_fields(there, path)

    def differs(name: str) -> bool:
        return name in there and there[name] != meta[name]

    if source.is_checkpoint:
        if differs("env"):
            raise UserError(f"{path} is a checkpoint of {there['env']}, not of {meta['env']}: pass --env {there['env']}")
        if differs("robot") or differs("fingerprint"):
            of = f"for {there['robot']}, not for {meta['robot']}" if differs("robot") else f"for another model of {meta['robot']}"
            raise UserError(f"{path} is a checkpoint {of}: pass the --robot that it was trained with")
        if differs("num_envs"):
            n = there["num_envs"]
            raise UserError(
                f"{path} does not fit: it holds {n} environments, this run has {meta['num_envs']}: pass --num-envs {n}"
            )
    made_by = there.get("learner", "ppo")
    if made_by != meta["learner"] and (source.is_checkpoint or not _same_policies(made_by, meta["learner"])):
        raise UserError(f"{path} was made by the learner {made_by}: pass --learner to say so")
    sized = ("observations", "observation_size", "action_size")
    if any(map(differs, sized)) or not header.acts_alike(there, meta):
        where = f"{there.get('env')} (preset {there.get('preset')})"
        raise UserError(
            f"{path} does not fit: it was trained in {where} on other observations or actions "
            f"than those of {meta['env']} (preset {meta['preset']}): give one that was trained on these"
        )
    if other := learner.find(meta["learner"]).differing(there, meta):
        flags = " ".join(f"--{meta['learner']}.{name} {_flag(x)}" for name, x in other.items())
        raise UserError(f"{path} does not fit, because its networks differ: pass {flags}")


def _same_policies(one: str, other: str) -> bool:
    """True if two learners train the same kind of policy, so that one can start from the other's."""
    return one in learner.names() and learner.find(one).policy is learner.find(other).policy


def _flag(value: Any) -> str:
    """Formats a field's value for a command line."""
    return "'" + ",".join(map(str, value)) + "'" if isinstance(value, tuple) else str(value)


def state(source: Source | None, fresh: compiled.Fresh, seed: int) -> Any:
    """Makes a new state, or loads a checkpoint's. A policy file gives only its networks.

    Args:
        fresh: makes a new state from ``seed``.

    Raises:
        UserError: the file is damaged or of another version, or its networks hold numbers that are not finite.
    """
    if source is None:
        return fresh.placed(seed)
    learner = fresh.learner
    like = state_shape(learner)
    if not source.is_checkpoint:
        networks = checkpoint_policy(source.path).params  # checked before the slow compilation
        if (found := _shapes(networks)) != (wanted := _shapes(learner.policy(like))):
            name = min(found.items() ^ wanted.items())[0]
            raise UserError(f"{source.path} does not fit: {name} is {found.get(name)}, expected {wanted.get(name)}")
        return learner.place(learner.with_policy(fresh(seed), networks))
    try:
        held = checkpoint.load(source.path, like)
        checkpoint.check_finite(learner.policy(held), source.path)
        return learner.place(held)
    except UserError as error:
        made_by = source.meta.get("version")
        raise UserError(f"{error} (it was made by version {made_by} of mjx_nero)" if made_by else str(error)) from None


def _shapes(networks: Any) -> dict[str, tuple[int, ...]]:
    """Returns the shape of each array, by name."""
    return {jax.tree_util.keystr(path): tuple(x.shape) for path, x in jax.tree_util.tree_leaves_with_path(networks)}
