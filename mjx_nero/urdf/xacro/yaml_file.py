"""Implements ``load_yaml``: plain values from a YAML file, with xacro's units."""

import math
import pathlib
from collections.abc import Callable
from typing import Any

from mjx_nero.files import read_yaml
from mjx_nero.files.yaml_loader import YamlLoader
from mjx_nero.urdf.xacro.budget import Budget, Fault, Value
from mjx_nero.urdf.xacro.evaluate import evaluate
from mjx_nero.urdf.xacro.functions import MATH, dictionary

_UNITS = {"radians": 1.0, "degrees": math.pi / 180, "meters": 1.0, "millimeters": 0.001, "foot": 0.3048, "inches": 0.0254}


def values(path: pathlib.Path, budget: Budget) -> Value:
    """Reads the file's content. Numeric keys are numbers; if a key is repeated, as in some makers' files, the last one counts.

    Raises:
        Fault: a value with a unit is not a number.
        UserError: the file cannot be read (see ``read_yaml``).
    """

    class Loader(YamlLoader):
        def mapping(self, node: Any) -> dict[Any, Any]:
            pairs = [
                (self.construct_object(key, deep=True), self.construct_object(value, deep=True)) for key, value in node.value
            ]
            return dictionary(pairs)

    def united(factor: float) -> Callable[[Any, Any], float]:
        def build(loader: Any, node: Any) -> float:
            number = evaluate(loader.construct_scalar(node), MATH.__getitem__, budget)
            if not isinstance(number, int | float):
                raise Fault(f"{node.tag} {node.value[:60]!r} is not a number")
            return number * factor

        return build

    for name, factor in _UNITS.items():
        Loader.add_constructor(f"!{name}", united(factor))
    Loader.add_constructor("tag:yaml.org,2002:map", Loader.mapping)
    return budget.checked(read_yaml(path, Loader))
