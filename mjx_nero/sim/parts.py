"""The kinds of things in a scene besides the robots, as one world of a batch has them: objects, banks, obstacles and fixtures.

Each kind is one class in its own file. A new kind is another ``Part``, which ``scene.parts`` lists.
"""

from collections.abc import Callable
from typing import Any

from jaxtyping import Array, Float

from mjx_nero.types import Carry, Key, Sim, Start, View

Fields = dict[str, Array]  # of a model, by MuJoCo's names


class Part:
    """One kind of thing in a scene. All methods are pure; by default they add nothing.

    Attributes:
        fields: fields of the physics model that differ between worlds because of this kind.
        seen: fields of the drawn model that differ because of this kind.
    """

    fields: tuple[str, ...] = ()
    seen: tuple[str, ...] = ()

    def blank(self) -> dict[str, Any]:
        """Returns its fields of ``Start``, before any reset event."""
        return {}

    def start(self, view: View, carry: Carry) -> dict[str, Any]:
        """Returns its fields of the ``Start`` of an episode that begins in this state, at rest."""
        return {}

    def given(self, start: Start) -> Fields:
        """Returns the model's fields that follow from a start. Randomization changes them afterwards."""
        return {}

    def qpos(self, qpos: Float[Array, " nq"], start: Start, fields: Fields) -> Float[Array, " nq"]:
        """Returns ``qpos`` with its joints where the start has them; ``fields`` are the world's."""
        return qpos

    def memory(self, start: Start) -> dict[str, Any]:
        """Returns what the episode has to remember of its start."""
        return {}

    def late(self, key: Key, see: Callable[[], View], fields: Fields) -> Fields:
        """Returns ``fields`` with what is drawn last, once start and goal are known.

        Args:
            key: the episode's key; each kind folds a number of its own into it.
            see: makes the view of the start.
        """
        return fields

    def view(self, sim: Sim, carry: Carry) -> dict[str, Any]:
        """Returns its fields of ``View``."""
        return {}

    def scenery(self, sim: Sim, carry: Carry, look: Fields) -> dict[str, Any]:
        """Returns its fields of ``Scenery``. ``look``, fields of the drawn model, is among them if it changes those."""
        return {}


class Parts(Part):
    """All kinds of things of a scene, as one."""

    def __init__(self, *parts: Part):
        self._parts = parts

    @property
    def fields(self) -> tuple[str, ...]:  # type: ignore[override]
        """See ``Part``."""
        return tuple(dict.fromkeys(name for part in self._parts for name in part.fields))

    @property
    def seen(self) -> tuple[str, ...]:  # type: ignore[override]
        """See ``Part``."""
        return tuple(dict.fromkeys(name for part in self._parts for name in part.seen))

    def blank(self) -> dict[str, Any]:
        return {name: value for part in self._parts for name, value in part.blank().items()}

    def start(self, view: View, carry: Carry) -> dict[str, Any]:
        return {name: value for part in self._parts for name, value in part.start(view, carry).items()}

    def given(self, start: Start) -> Fields:
        return {name: value for part in self._parts for name, value in part.given(start).items()}

    def qpos(self, qpos: Float[Array, " nq"], start: Start, fields: Fields) -> Float[Array, " nq"]:
        for part in self._parts:
            qpos = part.qpos(qpos, start, fields)
        return qpos

    def memory(self, start: Start) -> dict[str, Any]:
        return {name: value for part in self._parts for name, value in part.memory(start).items()}

    def late(self, key: Key, see: Callable[[], View], fields: Fields) -> Fields:
        for part in self._parts:
            fields = part.late(key, see, fields)
        return fields

    def view(self, sim: Sim, carry: Carry) -> dict[str, Any]:
        return {name: value for part in self._parts for name, value in part.view(sim, carry).items()}

    def scenery(self, sim: Sim, carry: Carry, look: Fields) -> dict[str, Any]:
        out: dict[str, Any] = {"look": look}
        for part in self._parts:
            out |= part.scenery(sim, carry, out["look"])
        return out
