"""Registries hold things of one kind by name: the package's own, and those that outside code registers."""

from collections.abc import Mapping
from typing import TypeVar

from mjx_nero.config.values import choices, hint, read, short
from mjx_nero.errors import UserError

Thing = TypeVar("Thing")


class Registry(dict[str, Thing]):
    """Things of one kind by name.

    Args:
        kind: word for one of them in messages.
        own: the package's own things.
    """

    def __init__(self, kind: str, own: Mapping[str, Thing]):
        super().__init__(own)
        self.kind = kind

    def add(self, name: str, thing: Thing) -> None:
        """Adds a thing.

        Raises:
            UserError: the name is taken.
        """
        if name in self:
            raise UserError(f"there is already a{'n' * (self.kind[0] in 'aeiou')} {self.kind} {name!r}: choose another name")
        self[name] = thing

    def find(self, name: str) -> Thing:
        """Finds a thing.

        Raises:
            UserError: the name is unknown.
        """
        return pick(self, name, self.kind)


def pick(table: Mapping[str, Thing], name: str, kind: str) -> Thing:
    """Looks up a name.

    Raises:
        UserError: the table does not have it; the message lists the names that it has, or the nearest.
    """
    if read(str, name, kind) not in table:
        raise UserError(f"unknown {kind} {short(name)}{hint(name, table)}: {choices(name, table)}")
    return table[name]
