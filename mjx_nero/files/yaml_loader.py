"""A YAML loader for plain values, with limits."""

import math
from typing import Any

import yaml

from mjx_nero.files import MAX_DEPTH, MAX_NODES


class YamlLoader(yaml.SafeLoader):
    """PyYAML's loader for plain values only, with limits that already apply while the file is read."""

    def __init__(self, content: bytes):
        super().__init__(content)
        self._count = self._depth = 0
        self._sizes: dict[int, int] = {}  # number of nodes in each node, by its id

    def compose_node(self, parent: Any, index: Any) -> Any:
        mark, alias = self.peek_event().start_mark, self.check_event(yaml.AliasEvent)
        before, self._depth = self._count, self._depth + 1
        if self._depth > MAX_DEPTH:
            raise yaml.MarkedYAMLError(problem=f"deeper than {MAX_DEPTH} levels", problem_mark=mark)
        node = super().compose_node(parent, index)
        self._depth -= 1
        if alias and id(node) not in self._sizes:
            raise yaml.MarkedYAMLError(problem="an alias inside its own anchor", problem_mark=mark)
        self._count += self._sizes[id(node)] if alias else 1
        if self._count > MAX_NODES:
            raise yaml.MarkedYAMLError(problem=f"more than {MAX_NODES} values", problem_mark=mark)
        self._sizes[id(node)] = self._count - before
        return node

    def mapping(self, node: Any) -> dict[str, Any]:
        out: dict[str, Any] = {}
        for key, value in node.value:
            if not isinstance(key, yaml.ScalarNode) or key.value in out:
                problem = f"key {key.value!r} occurs twice" if isinstance(key, yaml.ScalarNode) else "a key that is not a string"
                raise yaml.MarkedYAMLError(problem=problem, problem_mark=key.start_mark)
            out[key.value] = self.construct_object(value, deep=True)
        return out

    def integer(self, node: Any) -> int:
        value = self.construct_yaml_int(node) if len(node.value) < 100 else 1 << 63  # long sexagesimal ones take a long time
        if abs(value) >= 1 << 63:
            raise yaml.MarkedYAMLError(problem="a whole number of more than 64 bits", problem_mark=node.start_mark)
        return value

    def real(self, node: Any) -> float:
        try:
            value = self.construct_yaml_float(node) if len(node.value) < 100 else math.nan
        except OverflowError:
            value = math.nan
        if math.isnan(value) and node.value.lower() != ".nan":
            raise yaml.MarkedYAMLError(problem="a number too long or too large to read", problem_mark=node.start_mark)
        return value

    def refuse(self, node: Any) -> Any:
        raise yaml.MarkedYAMLError(problem=f"the tag {node.tag[:60]!r} is not supported", problem_mark=node.start_mark)


YamlLoader.yaml_implicit_resolvers = {  # without dates, which stay strings
    first: [rule for rule in rules if not rule[0].endswith((":timestamp", ":merge", ":value"))]
    for first, rules in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
YamlLoader.yaml_constructors = {
    f"tag:yaml.org,2002:{kind}": construct
    for kind, construct in {
        "null": YamlLoader.construct_yaml_null,
        "bool": YamlLoader.construct_yaml_bool,
        "int": YamlLoader.integer,
        "float": YamlLoader.real,
        "str": YamlLoader.construct_yaml_str,
        "seq": lambda loader, node: loader.construct_sequence(node, deep=True),
        "map": YamlLoader.mapping,
    }.items()
} | {None: YamlLoader.refuse}
