"""The package's own policies."""

import pathlib

from mjx_nero.config import values
from mjx_nero.errors import UserError
from mjx_nero.sim.robot import ASSETS


def shipped(env_name: str, preset: str = "default") -> pathlib.Path:
    """Returns the path of the bundled policy of an environment: the preset's, or else the default preset's."""
    own = ASSETS / "policies" / f"{env_name}_{preset}.safetensors"
    return own if own.is_file() else ASSETS / "policies" / f"{env_name}.safetensors"


def names() -> dict[str, pathlib.Path]:
    """Maps the names of all bundled policies to their files: the environment, or environment and preset with an underscore."""
    return {path.stem: path for path in sorted((ASSETS / "policies").glob("*.safetensors"))}


def find(name: str) -> pathlib.Path:
    """Returns the path of a bundled policy, or of a policy file.

    Raises:
        UserError: there is neither.
    """
    known = names()
    if name not in known and not pathlib.Path(name).exists():
        raise UserError(f"no policy file and no bundled policy {values.short(name)}{values.hint(name, known)}")
    return known.get(name) or pathlib.Path(name)
