"""Arms behind their drivers. Each module imports what its bus needs when it is asked for."""

from collections.abc import Mapping
from typing import Any

from mjx_nero.deploy.arm import Arm, Clock
from mjx_nero.deploy.drivers import bcap
from mjx_nero.deploy.executor import Lag
from mjx_nero.errors import UserError

KINDS = ("sim", "so101", "so100", "piper", "nero", "cobotta", "lerobot")


_ROBOTS = {"so101": "so_arm101", "so100": "so_arm100", "piper": "piper", "nero": "nero", "cobotta": "cobotta_pro_900"}


def check(kind: str, metadata: Mapping[str, Any]) -> None:
    """Checks that an arm is the robot of a policy.

    Raises:
        UserError: it is not, or there is no such arm.
    """
    if kind not in KINDS:
        raise UserError(f"no arm {kind!r}: choose one of {', '.join(KINDS)}")
    if (wanted := _ROBOTS.get(kind, metadata["robot"])) != metadata["robot"]:
        raise UserError(f"the policy is for {metadata['robot']}, and --arm {kind} is a {wanted}")


def ports(kind: str, options: Mapping[str, Any]) -> list[str]:
    """Returns the ports of an arm, which no other program may use meanwhile; none for the simulated arm.

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
    """A driver, not connected yet.

    Args:
        options: of the driver, as plain values: ``model`` and ``tracker`` of the simulated arm, ``port`` and ``calibration`` of
            the SO-ARMs, ``port`` (``INTERFACE:CHANNEL``) of the Piper and the
            Nero, ``port`` and ``gripper`` (``HOST:PORT``) of the Cobotta,
            ``port`` (``TYPE:field=value,...``) and ``calibration`` of LeRobot's.

    Raises:
        UserError: there is no such arm, a package or file is missing, or it is another robot than the policy's.
    """
    check(kind, metadata)
    joints = tuple(metadata["joints"]["names"])
    if kind == "sim":
        from mjx_nero.deploy.drivers import sim

        return sim.of(metadata, joints, Lag.of(metadata).lead, clock, **options)
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
