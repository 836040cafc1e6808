"""The self-test that ends an import: seconds of physics that show whether the robot does what its files claim."""

from mjx_nero.tools.self_test.checks import TRIES as TRIES
from mjx_nero.tools.self_test.checks import run as run
from mjx_nero.tools.self_test.result import Result as Result
