"""Drivers of arms. Each module imports the packages for its bus only when it is used."""

from collections.abc import Mapping
from typing import Any

from mjx_nero.deploy.arm import Arm, Clock
from mjx_nero.deploy.drivers import bcap
from mjx_nero.errors import UserError

KINDS = ("sim", "so101", "so100", "piper", "nero", "cobotta", "lerobot")


_ROBOTS = {"so101": "so_arm101", "so100": "so_arm100", "piper": "piper", "nero": "nero", "cobotta": "cobotta_pro_900"}


def check(kind: str, metadata: Mapping[str, Any]) -> None:
    """Checks that an arm is the robot of a policy.

    Raises:
        UserError: it is not, or the arm is unknown.
    """
    if kind not in KINDS:
        raise UserError(f"no arm {kind!r}: choose one of {', '.join(KINDS)}")
    if (wanted := _ROBOTS.get(kind, metadata["robot"])) != metadata["robot"]:
        raise UserError(f"--arm {kind} is a {wanted}, not a {metadata['robot']}: pass another --arm, policy or --robot")


def ports(kind: str, options: Mapping[str, Any]) -> list[str]:
    """Returns the ports of an arm, which no other program may use at the same time; none for the simulated arm.

    Args:
        options: see ``make``.
    """
    told = options.get("port") or ""
    if kind == "lerobot":  # TYPE:field=value,...
        told = next((part[5:] for part in told.partition(":")[2].split(",") if part.startswith("port=")), told)
    elif kind == "cobotta":
        told = told.removeprefix("udp:").removesuffix(f":{bcap.PORT}")
    return [port for port in (told.removeprefix("slcan:"), options.get("gripper")) if port]


def make(kind: str, options: Mapping[str, Any], metadata: Mapping[str, Any], clock: Clock) -> Arm:
    """Makes a driver, which is not connected yet.

    Args:
        options: the driver's options as plain values: ``model`` and ``tracker`` for the simulated arm; ``port`` and
            ``calibration`` for SO-ARMs; ``port`` (``INTERFACE:CHANNEL``) for Piper and Nero; ``port`` and ``gripper``
            (``HOST:PORT``) for the Cobotta; ``port`` (``TYPE:field=value,...``) and ``calibration`` for LeRobot's arms.

    Raises:
        UserError: the arm is unknown or not the policy's robot, or a package or file is missing.
    """
    check(kind, metadata)
    if kind == "sim":
        from mjx_nero.deploy.drivers import sim

        return sim.of(metadata, clock, **options)
    if kind in ("so101", "so100"):
        from mjx_nero.deploy.drivers import so_arm

        return so_arm.of(kind, metadata, clock, **options)
    if kind == "lerobot":
        from mjx_nero.deploy.drivers import lerobot

        return lerobot.of(metadata, clock, **options)
    if kind == "cobotta":
        from mjx_nero.deploy.drivers import cobotta

        return cobotta.of(metadata, clock, **options)
    from mjx_nero.deploy.drivers import agilex

    return agilex.of(kind, metadata, clock, **options)
