"""The package's own policies."""

import pathlib

from mjx_nero.sim.robot import ASSETS


def shipped(env_name: str, preset: str = "default") -> pathlib.Path:
    """Returns the path of the bundled policy of an environment: the preset's, or else the default preset's."""
    own = ASSETS / "policies" / f"{env_name}_{preset}.safetensors"
    return own if own.is_file() else ASSETS / "policies" / f"{env_name}.safetensors"


def names() -> dict[str, pathlib.Path]:
    """Maps the names of all bundled policies to their files: the environment, or environment and preset with an underscore."""
    return {path.stem: path for path in sorted((ASSETS / "policies").glob("*.safetensors"))}
