"""Expressions of xacro files: what they can calculate, that they can do nothing else, and that they end."""

import math

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mjx_nero.types import UserError
from mjx_nero.urdf.xacro import yaml_file
from mjx_nero.urdf.xacro.budget import LIMITS, MAX_SIZE, Budget, Fault, size
from mjx_nero.urdf.xacro.evaluate import Names, evaluate
from mjx_nero.urdf.xacro.functions import MATH, PYTHON, XACRO

CFG = {"joints": {"j1": {"max": 2.5, "min": -1}}, "names": ["a", "b"], "items": 3}
NAMES = {
    **MATH,
    **PYTHON,
    "math": Names(MATH),
    "python": Names(PYTHON),
    "xacro": Names(XACRO),
    "cfg": CFG,
    "n": 2,
    "word": "ur5e",
}


@pytest.fixture(autouse=True)
def fewer_steps(monkeypatch):
    """The tests' type checks make a step ten times as long; test_expand.py has the limit itself."""
    monkeypatch.setitem(LIMITS, "evaluation steps", 50_000)


def value(expression: str):
    return evaluate(expression, NAMES.__getitem__, Budget())


VALUES = {
    "1 + 2 * 3 - 4 / 8": 6.5,
    "7 // 2, 7 % 4, -2 ** 2": (3, 3, -4),
    "2 ** 10": 1024,
    "pi / 2": math.pi / 2,
    "radians(180)": math.pi,
    "math.degrees(math.pi)": 180.0,
    "n < 3 <= 3 and not n > 5": True,
    "0 or word": "ur5e",
    "n is not None": True,
    "'' is ''": True,
    "1 is True": False,
    "'long' if n > 5 else 'short'": "short",
    "word in ('ur3e', 'ur5e')": True,
    "word[2:] + '_' + str(n)": "5e_2",
    "word.upper().replace('R', '-')": "U-5E",
    "'0.1 0.2'.split()[1]": "0.2",
    "'1 2 3'.split(' ')": ["1", "2", "3"],
    "' '.join(['x', 'y'])": "x y",
    "word.startswith('ur') and word.endswith('e')": True,
    "cfg['joints']['j1']['max']": 2.5,
    "cfg.joints.j1.min": -1,
    "cfg.get('none', 7)": 7,
    "list(map(float, '1 2.5'.split(' ')))": [1.0, 2.5],
    "map(max, [1, 4], [3, 2, 9])": [3, 4],
    "sum(map(math.cos, [0, 0]))": 2.0,
    "list(cfg.joints.j1.keys())": ["max", "min"],
    "[x * n for x in range(4) if x]": [2, 4, 6],
    "sum(x * y for x, y in zip([1, 2], [3, 4]))": 11,
    "dict(a=1, b=[2])": {"a": 1, "b": [2]},
    "{'a': 1, 2: n}": {"a": 1, 2: 2},
    "{k: 1 for k in cfg.names}": {"a": 1, "b": 1},
    "max(1, 5, 3) + min([4, 2])": 7,
    "round(2.567, 1)": 2.6,
    "sorted([3, 1, 2])": [1, 2, 3],
    "list(reversed([1, 2]))": [2, 1],
    "'%s_%03d %.2f' % (word, 7, 1.5)": "ur5e_007 1.50",
    "'%(a)d' % dict(a=3)": "3",
    "xacro.tokenize('a, b;c')": ["a", "b", "c"],
    "python.abs(-3)": 3,
    "int('7') + float('.5')": 7.5,
    "len('abc') * [0]": [0, 0, 0],
    "5 & 3 | 8 ^ 1": 9,
    "1 << 4 >> 2": 4,
}


@pytest.mark.parametrize("expression", VALUES)
def test_value(expression):
    found = value(expression)
    assert found == VALUES[expression] and type(found) is type(VALUES[expression])


REFUSED = {
    # ways out of an expression
    "().__class__": "no attribute '__class__'",
    "''.__class__.__mro__": "no attribute",
    "(lambda: 1)()": "only functions that have a name",
    "[f() for f in [lambda: 1]]": "only functions that have a name|not a function|Lambda",
    "(lambda: [c for c in ().__class__.__base__.__subclasses__()])()": "only functions",
    "__import__('os').system('id')": "there is no '__import__'",
    "open('/etc/passwd')": "there is no 'open'",
    "eval('1')": "there is no 'eval'",
    "getattr(1, 'real')": "there is no 'getattr'",
    "type('x')": "there is no 'type'",
    "vars()": "there is no 'vars'",
    "len.__globals__": "a function has no attribute",
    "math.__dict__": "there is no '__dict__'",
    "math.pi.real": "a float has no attribute",
    "cfg.__class__": "there is no '__class__'",
    "cfg.keys.__self__": "there is no 'keys'",
    "cfg.update(a=1)": "no method 'update'",
    "cfg.names.append(1)": "no method 'append'",
    "'{0.__class__}'.format(1)": "no method 'format'",
    "'a'.format_map(cfg)": "no method 'format_map'",
    "f'{n}'": "JoinedStr is not supported",
    "(n := 3)": "NamedExpr is not supported",
    "[*range(3)]": "Starred is not supported",
    "dict(**cfg)": r"\*\* in calls",
    "max(*[1, 2])": r"\* and",
    "{**cfg}": "Dict is not supported",
    "{1, 2}": "Set is not supported",
    "n @ n": "BinOp is not supported",
    "b'x'": "Constant is not supported",
    "1j": "Constant is not supported",
    "...": "Constant is not supported",
    "(-8) ** 0.5": "complex is not a value",
    "sorted([1], key=len)": "function is not a value",
    "str(len)": "function is not a value",
    "[len]": "function is not a value",
    "len": "function is not a value",
    "map(lambda x: x, [1])": "only functions that have a name",
    "map(map, [len], [1])": "there is no 'map'",
    "map(''.__class__, [1])": "no method '__class__'",
    "map(len, [len])": "function is not a value",
    "map(range, range(9999))": "evaluation steps|items",
    "map()": "missing",
    "math": "names is not a value",
    "max([1], key='x')": "not callable",
    "import os": "is not an expression",
    "x = 1": "is not an expression",
    "": "is not an expression",
    "1 +": "is not an expression",
    "a\0b": "is not an expression",
    "(" * 300 + ")" * 300: "is not an expression",
    "-" * 3000 + "1": "is not an expression|recursion|nest",
    # too much of something
    "9**9**9": "bits",
    "1 << 10**9": "bits",
    "2 ** 500 * 2 ** 600": "bits",
    "int('f' * 1000, 16)": "bits",
    "10.0 ** 400": "too large|out of range",
    "len([0] * 2000000000)": "items",
    "2000000000 * (0,)": "items",
    "'a' * 10**9": "characters",
    "'%999999999d' % 1": "is not supported",
    "'%*d' % (999999999, 1)": "is not supported",
    "'%.999999999f' % 1": "is not supported",
    "'%999d' * 1000 % 1": "characters|is not supported|arguments",
    "('%(a)s' * 10000) % dict(a='x' * 90000)": "characters",
    "('x' * 1000).join(['a'] * 1000)": "characters",
    "('a' * 1000).replace('a', 'b' * 1000)": "characters",
    "('a' * 50000).split('a') * 9": "items",
    "list(range(10**12))": "items",
    "range(10**400)": "bits",
    "round(10, -10**9)": "digits",
    "[[[0] * 100] * 100] * 100": "items",
    "[x for x in range(9999) for y in range(9999)]": "items|steps",
    "sum(1 for x in range(9999) for y in range(9999))": "steps",
    "sum([[1], [2]], [])": "takes numbers",
    "['a' * 50000 + str(i) for i in range(9999)]": "steps|characters",
    "{2**61 * i: 0 for i in range(9)}": "is no key",
    "{(1, 2): 0}": "is no key",
    "{[1]: 0}": "unhashable",
    "1 +" * 2000 + "1": "characters|nest|recursion",
    # plain mistakes
    "1 / 0": "division by zero",
    "'a' + 1": "concatenate",
    "cfg['x']": "there is no 'x'",
    "[1][5]": "out of range",
    "n.x": "a int has no attribute",
    "n()": "not a function",
    "unknown + 1": "there is no 'unknown'",
    "sqrt(-1)": "domain",
    "xacro.fatal('no', n)": "the file says: no 2",
}


@pytest.mark.parametrize("expression", REFUSED, ids=lambda e: e[:40])
def test_refused(expression):
    with pytest.raises((Fault, RecursionError), match=REFUSED[expression]) as error:  # the expander reports RecursionError
        value(expression)
    assert len(str(error.value)) < 400 or error.type is RecursionError


_ATOMS = st.sampled_from(
    "0 1 -7 2.5 1e300 10**9 'a' 'ab_c' '%d' '%999d' '' n word cfg cfg.names cfg.joints pi [0] (1,2) [] {} True None range(9) len "
    "str math xacro().__class__ __import__ x i".split()
)
_NAMES = st.sampled_from(
    [*PYTHON, *MATH, "math.sin", "python.abs", "xacro.tokenize", "xacro.dotify", "eval", "open", "type", "getattr"]
)
_MEMBERS = st.sampled_from(
    "lower upper split join replace strip startswith format get keys items values append count index joints __class__ "
    "__globals__ real".split()
)
_BINARY = st.sampled_from("+ - * / // % ** << >> & | ^ and or == != < <= in is not-in".split()).map(lambda o: o.replace("-", " "))


def _grown(inner):
    return st.one_of(
        st.builds("({} {} {})".format, inner, _BINARY, inner),
        st.builds("{}({})".format, _NAMES, inner),
        st.builds("{}({}, {})".format, _NAMES, inner, inner),
        st.builds("({}).{}({})".format, inner, _MEMBERS, inner),
        st.builds("({}).{}".format, inner, _MEMBERS),
        st.builds("({})[{}]".format, inner, inner),
        st.builds("({})[{}:]".format, inner, inner),
        st.builds("[{}, {}]".format, inner, inner),
        st.builds("{{{}: {}}}".format, inner, inner),
        st.builds("[{} for x in {}]".format, inner, inner),
        st.builds("[{} for i in {} if {}]".format, inner, inner, inner),
        st.builds("({} if {} else {})".format, inner, inner, inner),
        st.builds("(lambda x: {})({})".format, inner, inner),
    )


EXPRESSIONS = st.one_of(st.recursive(_ATOMS, _grown, max_leaves=25), st.text(max_size=60))


FIXTURE = HealthCheck.function_scoped_fixture


@given(EXPRESSIONS)
@settings(max_examples=300, deadline=None, suppress_health_check=[FIXTURE])
def test_any_expression_ends_in_a_plain_value_or_a_fault(expression):
    try:
        found = value(expression)
    except (Fault, RecursionError):
        return
    assert size(found) <= MAX_SIZE  # raises for anything but plain values


YAML = {
    "joint: {max: !degrees 180, min: !degrees -90}": {"joint": {"max": math.pi, "min": -math.pi / 2}},
    "a: !radians pi/2": {"a": math.pi / 2},
    "a: !millimeters 5": {"a": 0.005},
    "1: a\n2.5: b\nx: 2024-01-01": {1: "a", 2.5: "b", "x": "2024-01-01"},
    "a: 1\na: 2": {"a": 2},
    "- 1\n- 2.5\n- true\n- x\n- null": [1, 2.5, True, "x", None],
    "a: &x [1, 2]\nb: *x": {"a": [1, 2], "b": [1, 2]},
    "": None,
}


def read(folder, text: str):
    path = folder / "x.yaml"
    path.write_bytes(text.encode())
    return yaml_file.values(path, Budget())


@pytest.mark.parametrize("text", YAML)
def test_yaml(tmp_path, text):
    assert read(tmp_path, text) == YAML[text]


_BOMB = "a0: &a0 [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 12)
)
BAD_YAML = {
    "[" * 500: "deeper",
    "[" * 90_000: "deeper",
    _BOMB: "more than 20000 values|items",
    "a: &a [*a]": "alias",
    "!!python/object/apply:os.system [id]": "tag .* is not supported",
    "a: !!python/name:os.system": "tag .* is not supported",
    "a: !!int x": "invalid literal",
    "a: !!binary eA==": "tag .* is not supported",
    "a: !!set {x}": "tag .* is not supported",
    "a: 0x" + "f" * 9_000: "64 bits",
    "a: 1" + ":1" * 90_000: "64 bits",
    "a: !degrees x()": "there is no 'x'",
    "a: !degrees 9**9**9": "bits",
    "a: !degrees [1]": "scalar",
    "a: b: c": "not YAML",
    "\x00": "not YAML",
    "? [1, 2]\n: 3": "unhashable",
}


@pytest.mark.parametrize("text", BAD_YAML, ids=lambda t: t[:30])
def test_bad_yaml(tmp_path, text):
    with pytest.raises((Fault, UserError), match=BAD_YAML[text]):
        read(tmp_path, text)


_YAML_TEXT = st.text(alphabet="ab:- \n[]{},&*!#|>%@`'\"?0159.\t<", max_size=200)


@given(st.one_of(_YAML_TEXT, st.binary(max_size=100).map(lambda b: b.decode("latin1"))))
@settings(max_examples=200, deadline=None, suppress_health_check=[FIXTURE])
def test_any_yaml_ends_in_plain_values_or_a_fault(tmp_path, text):
    try:
        assert size(read(tmp_path, text)) <= MAX_SIZE
    except (Fault, UserError) as error:
        assert len(str(error)) <= 500
