"""``deploy --check``: moves an arm's joints one by one, and reports what it found and whether to continue."""

import pathlib
import sys
from collections.abc import Mapping
from typing import Any

from mjx_nero import files
from mjx_nero.deploy import check, setup, stop
from mjx_nero.deploy.arm import Clock
from mjx_nero.deploy.guard import Guarded
from mjx_nero.deploy.safety import Limits


def checked(arm: Guarded, limits: Limits, metadata: Mapping[str, Any], clock: Clock, ends: stop.Stop, out: pathlib.Path) -> bool:
    """Moves the joints of an arm at home one by one, prints a go or no-go list, and writes the findings.

    Returns:
        True if a joint or a fault forbids going on.
    """

    def ask(question: str) -> bool | None:
        """Asks for y or n while the arm holds; returns None if there is no terminal or the arm faults."""
        if not sys.stdin or not sys.stdin.isatty():
            return None
        print(f"  {question} [y/n] ", end="", flush=True)
        stop.typed.clear()
        at = arm.read().position
        while not arm.fault:
            due = clock.now() + limits.dt
            if ending := ends():
                arm.hold(ending)
            arm.read()
            arm.command(at)
            while stop.typed:
                if (key := stop.typed.popleft().lower()) in "yn":
                    print(key)
                    return key == "y"
            clock.sleep_until(due)
        return None

    found, fault = check.walk(arm, limits, setup.body_of(metadata), clock, ends, ask)
    grips = metadata["gripper"]
    print("joint: follows, scale, offset, delay, seen by you")
    for joint in found:
        seen = {True: "yes", False: "NO", None: "not asked"}[joint.seen]
        wrong = joint.wrong(joint.name in grips)
        line = f"{joint.name}: {joint.follows}, {joint.scale:+.2f}, {joint.offset:+.4f}, {1e3 * joint.delay:.0f} ms, {seen}"
        print(f"{'NO-GO' if wrong else 'go   '} {line}{'; ' if wrong else ''}{'; '.join(wrong)}")
    if fault:
        print(f"NO-GO the arm holds: {fault.text}")
        return True
    files.write(out, check.yaml_of(metadata["robot"], found, [n for n in limits.names if n not in grips]).encode())
    bad = any(joint.wrong(joint.name in grips) for joint in found)
    print(f"drives: {out}")
    print("no-go: fix that first" if bad else "go: next --dry-run, then --speed 0.3 --seconds 5 with nothing in reach")
    return bad
