"""The self-test at the end of an import: a few seconds of simulation that show whether the robot does what its files claim."""

from mjx_nero.tools.self_test.checks import TRIES as TRIES
from mjx_nero.tools.self_test.checks import run as run
from mjx_nero.tools.self_test.result import Result as Result
