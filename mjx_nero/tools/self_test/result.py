"""Results of a self-test, as values and as one line."""

import dataclasses
from typing import Any


@dataclasses.dataclass(frozen=True)
class Result:
    """The results of a self-test in simulation.

    Attributes:
        gripper: where the gripper stops before its declared limits, and why; empty if it reaches them.
        home: what touches in the home pose; empty if nothing does.
        script: what was tried: ``pick_place``, ``reach`` (without a gripper that can grasp), or empty.
        tries: number of tries, of which ``good`` grasped the cube or reached the goal, and ``placed`` put the cube at the goal.
        failures: phase of the script -> number of tries that failed in it.
        reason: why there were no tries; or what was observed in the phase where most tries failed, and what to look at.
        has_gripper: whether the robot has a gripper.
        seconds: time that the test took.
    """

    gripper: str
    home: str
    script: str
    tries: int
    good: int
    placed: int
    failures: dict[str, int]
    reason: str
    has_gripper: bool
    seconds: float

    @property
    def passed(self) -> bool:
        """True if no check found a fault."""
        return not (self.gripper or self.home or self.reason)

    @property
    def line(self) -> str:
        """Returns all results as one line."""
        parts = [self.gripper or "the gripper opens and closes"] if self.has_gripper else []
        parts.append(self.home or "home touches nothing")
        if self.script == "pick_place":
            parts.append(f"the script grasps the cube in {self.good} of {self.tries} tries and places it in {self.placed}")
        elif self.script:
            parts.append(f"the arm reaches {self.good} of {self.tries} points of its workspace")
        where = ", ".join(f"{count} fail{'s' * (count == 1)} at {phase!r}" for phase, count in self.failures.items())
        parts += [part for part in (where, self.reason) if part]
        return f"self-test: {'; '.join(parts)}"

    def json(self) -> dict[str, Any]:
        """Returns the content for ``report.json``."""
        return {**dataclasses.asdict(self), "passed": self.passed, "line": self.line}
