"""What learns: a protocol, and learners by name. Training, evaluation and the benchmark know no more of a learner than this."""

import dataclasses
import importlib
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Protocol

from mjx_nero import config
from mjx_nero.errors import UserError

if TYPE_CHECKING:
    import jax
    from brax.envs.base import Env

    from mjx_nero.types import Bank, Key

Params = Any  # what a policy acts by: a pytree of arrays
Metrics = dict[str, "jax.Array"]
Observation = Mapping[str, "jax.Array"]
Act = Callable[[Params, Observation], "jax.Array"]


class State(Protocol):
    """A pytree with all of a run: saved and loaded as it is, training goes on bit for bit."""

    iteration: Any  # how many ``run`` has made so far, int32


class Learner(Protocol):
    """Learns on a batch of environments. ``init`` and ``run`` are pure.

    Attributes:
        env: from ``wrappers.for_training``.
        num_envs: on all devices together.
        num_devices: over how many they are spread.
        divisor: ``num_envs`` is a multiple of it.
        steps_per_iteration: env steps.
    """

    env: "Env"
    num_envs: int
    num_devices: int
    divisor: int
    steps_per_iteration: int

    def init(self, key: "Key", bank: "Bank | None" = None) -> Any:
        """A fresh ``State``; ``bank`` is for the environments' ``reset``, where the task asks for an expert's starts."""
        ...

    def place(self, state: Any) -> Any:
        """The state, or its shapes, where ``run`` takes it: spread over the devices."""
        ...

    def run(self, state: Any, iterations: int) -> tuple[Any, Metrics]:
        """So many iterations, and means of their metrics. ``sum/<name>``: an environment's metric summed over an iteration."""
        ...

    def policy(self, state: Any) -> Params:
        """What the policy acts by, on one device."""
        ...

    def with_policy(self, state: Any, params: Params) -> Any:
        """A fresh state that starts from a policy."""
        ...

    def slower(self, state: Any) -> Any:
        """The state, learning more slowly and from other draws: to go back to after divergence."""
        ...

    def act(self, params: Params, obs: Observation) -> "jax.Array":
        """The deterministic action; single or batched."""
        ...

    def describe(self) -> dict[str, Any]:
        """What a policy file says of the policy beside the environment, enough for ``Kind.policy``; plain JSON."""
        ...

    def footprint(self) -> tuple[float, float]:
        """About what ``run`` takes of a device's memory [bytes]: in any case, and for each environment there."""
        ...


@dataclasses.dataclass(frozen=True)
class Kind:
    """A way to learn.

    Attributes:
        make: (environment from ``wrappers.for_training``, config, number of devices) -> learner.
        presets: its config by the environment's preset; ``default`` for the others. A frozen dataclass with at least ``num_envs``
            and ``num_timesteps``, 0: chosen for the machine.
        policy: what a policy file says -> a template of the policy's parameters, and how it acts.
        fit: (config, number of devices that a run starts on) -> the config with what they decide, which the run keeps.
        held: where a checkpoint holds the policy's parameters: the start of their names in a policy's file -> in the learner's
            state, as in ``{"['w']": ".best"}``. Empty: no checkpoint can be played, only a policy's file.
        differing: (what a file says of its policy, what the run's own says) -> the config's fields in which they differ, by
            dotted name, with the file's values.
    """

    make: Callable[["Env", Any, int], Learner]
    presets: Mapping[str, Any]
    policy: Callable[[Mapping[str, Any]], tuple[Params, Act]]
    fit: Callable[[Any, int], Any] = lambda cfg, _: cfg
    held: Mapping[str, str] = dataclasses.field(default_factory=dict)
    differing: Callable[[Mapping[str, Any], Mapping[str, Any]], dict[str, Any]] = lambda there, here: {}


# The package's own: the folder whose ``learner`` has its ``KIND``; the presets stand in ``cfg`` beside it, without Brax.
_KINDS: dict[str, Kind | str] = {"ppo": "mjx_nero.learn.ppo"}


def register(name: str, kind: Kind) -> None:
    """Adds a learner: ``--learner NAME`` trains with it, ``--NAME.field`` sets its config.

    Raises:
        UserError: there is one of that name.
    """
    if name in _KINDS:
        raise UserError(f"there is a learner {name!r} already: register it under another name")
    _KINDS[name] = kind


def names() -> tuple[str, ...]:
    """Names of all learners."""
    return tuple(_KINDS)


def find(name: str) -> Kind:
    """A learner by name.

    Raises:
        UserError: unknown.
    """
    kind = _KINDS.get(name)
    if kind is None:
        raise UserError(f"unknown learner {name!r}{config.hint(name, _KINDS)}: choose one of {', '.join(_KINDS)}")
    return importlib.import_module(f"{kind}.learner").KIND if isinstance(kind, str) else kind


def cfg_for(name: str, preset: str, fields: Mapping[str, Any]) -> Any:
    """The config of a learner that goes with an environment's preset.

    Args:
        fields: what the task asks for, by dotted name (``EnvCfg.training``); those that this learner does not have are left out.
    """
    kind = _KINDS.get(name)
    presets = importlib.import_module(f"{kind}.cfg").PRESETS if isinstance(kind, str) else find(name).presets
    cfg = presets.get(preset, presets["default"])
    known = config.flatten(cfg)
    return config.override(cfg, {field: value for field, value in fields.items() if field in known})
