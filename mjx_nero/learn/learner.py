"""The protocol of learners, and a registry of them. Training, evaluation and benchmarks know nothing more of a learner."""

import dataclasses
import importlib
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Protocol

from mjx_nero import config
from mjx_nero.config.registry import Registry
from mjx_nero.errors import UserError

if TYPE_CHECKING:
    import jax
    from brax.envs.base import Env

    from mjx_nero.types import Bank, Key

DEMONSTRATIONS = 64  # episodes that an expert plays for a learner
ROWS = 256  # rows of ``types.Shown`` for each of them
PRECISION = "float32"  # of products, where a learner asks for no other
HELD = {"[0]": ".normalizer", "[1]": ".params"}  # ``Kind.held`` of a state with these two
Params = Any  # a policy's parameters: a pytree of arrays
Metrics = dict[str, "jax.Array"]
Observation = Mapping[str, "jax.Array"]
Act = Callable[[Params, Observation], "jax.Array"]


class State(Protocol):
    """The whole state of a run, as a pytree. Training that resumes from a saved state continues bit for bit."""

    iteration: Any  # iterations so far, int32


class Learner(Protocol):
    """Learns on a batch of environments. ``init`` and ``run`` are pure.

    The methods that are not abstract are those of one device, and of a state with ``normalizer`` and ``params``, the policy.

    Attributes:
        env: the batch, from ``wrappers.for_training``.
        num_envs: number of environments on all devices together.
        num_devices: number of devices that they are spread over.
        divisor: ``num_envs`` must be a multiple of it.
        imitates: True if ``init`` also takes ``shown``, steps of an expert (``types.Shown``). May be missing: False.
        demonstrations: number of the expert's episodes, with ``ROWS`` steps in ``shown`` for each. May be missing.
        steps_per_iteration: env steps of an iteration.
    """

    env: "Env"
    num_envs: int
    num_devices: int
    divisor: int
    steps_per_iteration: int

    def init(self, key: "Key", bank: "Bank | None" = None) -> Any:
        """Makes a new ``State``. ``bank`` goes to the environments' ``reset``, if the task asks for expert starts.

        It must not step the environments: their physics is prepared beside it.
        """

    def place(self, state: Any) -> Any:
        """Spreads the state, or its shapes, over the devices, as ``run`` takes it."""
        return state

    def run(self, state: Any, iterations: int) -> tuple[Any, Metrics]:
        """Makes ``iterations`` iterations; returns the state and the mean metrics of an iteration.

        ``sum/<name>`` is an environment's metric summed over an iteration.
        """

    def parts(self) -> "tuple[Part, ...]":
        """Returns what an iteration is made of, if its parts may be programs of their own, which compile side by side. The method
        may be missing: one program makes several iterations then.
        """
        return ()

    def policy(self, state: Any) -> Params:
        """Returns the policy's parameters on one device, or their shapes if it gets the state's."""
        return state.normalizer, state.params

    def with_policy(self, state: Any, params: Params) -> Any:
        """Returns a new state that starts from a policy."""
        return dataclasses.replace(state, normalizer=params[0], params=params[1])

    def slower(self, state: Any) -> Any:
        """Returns the state with a lower learning rate and other random draws, for a restart after divergence."""

    def act(self, params: Params, obs: Observation) -> "jax.Array":
        """Computes the deterministic action, single or batched."""

    def describe(self) -> dict[str, Any]:
        """Describes the policy for its file, beside the environment: plain JSON, enough for ``Kind.policy``."""

    def footprint(self) -> tuple[float, float]:
        """Estimates the memory of ``run`` on a device [bytes]: the fixed part, and the part per environment."""


@dataclasses.dataclass(frozen=True)
class Part:
    """A part of an iteration.

    Attributes:
        name: what it does, for people and for the names of kept programs.
        function: (state, what the part before gives) -> state and what it gives. The first part gets nothing that it needs, the
            last one gives metrics as ``Learner.run`` does. Pure.
        small: it draws too rarely for the speed of random numbers to matter (see ``machines.small``).
        plain: its products are too few for Triton to matter (see ``machines.plain``).
    """

    name: str
    function: Callable[[Any, Any], tuple[Any, Any]]
    small: bool = False
    plain: bool = False


@dataclasses.dataclass(frozen=True)
class Kind:
    """A registered learner.

    Attributes:
        make: (environment from ``wrappers.for_training``, config, number of devices) -> learner.
        presets: its config for each preset of an environment; ``default`` for the others. A config is a frozen dataclass with at
            least ``num_envs`` and ``num_timesteps``, where 0 means chosen for the machine.
        policy: description in a policy's file -> (template of the policy's parameters, act function).
        stored: (policy's parameters, description) -> the parameters as a file holds them: fewer bytes, the same actions.
        envs: default number of environments on a CPU, and on a GPU.
        pace: speed of a GPU, shown to users who train without one.
        fit: (config, devices at the run's start) -> the config with what their number decides, which the run keeps.
        held: prefix of the parameters' names in a policy's file -> their prefix in the learner's state, as in
            ``{"['w']": ".best"}``. Empty: only policy files can be played, not checkpoints.
        differing: (description in a file, the run's own) -> the config's fields that differ, by dotted name, with the file's
            values.
        graph: a module that draws its policies as ONNX graphs, such as ``learn.pixels.graph``; None: they are PPO's layers.
    """

    make: Callable[["Env", Any, int], Learner]
    presets: Mapping[str, Any]
    policy: Callable[[Mapping[str, Any]], tuple[Params, Act]]
    stored: Callable[[Params, Mapping[str, Any]], Params] = lambda params, meta: params
    envs: tuple[int, int] = (256, 8192)
    pace: str = "an NVIDIA H200 makes 60 M steps of 8,192 environments in half a minute"
    fit: Callable[[Any, int], Any] = lambda cfg, _: cfg
    held: Mapping[str, str] = dataclasses.field(default_factory=dict)
    differing: Callable[[Mapping[str, Any], Mapping[str, Any]], dict[str, Any]] = lambda there, here: {}
    graph: Any = None


def state_shape(learner: Learner) -> Any:
    """Returns a new state's shapes, traced once. Nothing comes to the device, whose first array takes seconds."""
    import jax  # not needed for names and configs

    own = vars(learner)
    if "_state_shape" not in own:
        own["_state_shape"] = jax.eval_shape(lambda: learner.init(jax.random.PRNGKey(0)))
    return own["_state_shape"]


def repeated(iterate: Callable[[Any], tuple[Any, Metrics]], state: Any, iterations: int) -> tuple[Any, Metrics]:
    """Repeats an iteration, as ``Learner.run`` does; returns the state and the mean metrics."""
    import jax  # not needed for names and configs

    with jax.default_matmul_precision(PRECISION):
        state, metrics = jax.lax.scan(lambda s, _: iterate(s), state, length=iterations)
    return state, {name: value.mean() for name, value in metrics.items()}


# The package's learners: folders whose ``learner`` holds the ``KIND``, and whose ``cfg`` holds presets without importing Brax.
# ``--learner NAME`` trains with one, ``--NAME.field`` sets its config.
_OWN = {
    "ppo": "mjx_nero.learn.ppo",
    "clone": "mjx_nero.imitation.clone",
    "distill": "mjx_nero.imitation.distill",
    "pixels": "mjx_nero.learn.pixels",
}
KINDS: Registry[Kind | str] = Registry("learner", _OWN)


def add(name: str, kind: Kind) -> None:
    """Adds a learner.

    Raises:
        UserError: the name is taken, or the learner has no config for presets that it does not name.
    """
    if "default" not in kind.presets:
        raise UserError(f"the learner {name!r} has no preset 'default': give it the config for presets that it does not name")
    KINDS.add(name, kind)


def names() -> tuple[str, ...]:
    """Returns the names of all learners."""
    return tuple(KINDS)


def find(name: str) -> Kind:
    """Finds a learner by name.

    Raises:
        UserError: there is no such learner.
    """
    kind = KINDS.find(name)
    return importlib.import_module(f"{kind}.learner").KIND if isinstance(kind, str) else kind


def cfg_for(name: str, preset: str, fields: Mapping[str, Any]) -> Any:
    """Returns a learner's config for a preset of an environment.

    Args:
        fields: the task's settings by dotted name (``EnvCfg.training``); fields that this learner lacks are ignored.
    """
    kind = KINDS.find(name)
    presets = importlib.import_module(f"{kind}.cfg").PRESETS if isinstance(kind, str) else kind.presets
    cfg = presets.get(preset, presets["default"])
    known = config.flatten(cfg)
    return config.override(cfg, {field: value for field, value in fields.items() if field in known})
