"""The sources of a policy's object positions and pictures, and the scene of a simulated or emulated arm."""

import argparse
import contextlib
import dataclasses
import functools
import pathlib
from collections.abc import Iterator, Mapping
from typing import Any

from mjx_nero.errors import UserError
from mjx_nero.tools.deploy import arms


@dataclasses.dataclass(frozen=True)
class World:
    """Surroundings of a simulated arm.

    Attributes:
        robot, scene, sim: configs.
        objects: first positions of the objects, in the root frame [m].
    """

    robot: Any
    scene: Any
    sim: Any
    objects: Mapping[str, Any]


@contextlib.contextmanager
def places_and_options(args: argparse.Namespace, metadata: dict[str, Any]) -> Iterator[tuple[Any, dict[str, Any]]]:
    """Yields the source of object positions, and the driver's options."""
    from mjx_nero.deploy import places

    simulated = args.arm == "sim" or args.emulate
    constant, told = args.object is not None and _is_point(args.object), None
    if args.object is None and not simulated:
        source: Any = places.Known()
    elif simulated and (args.object is None or constant):  # the simulated object starts there and is tracked
        source = places.FromSocket("udp", "127.0.0.1", 0)
        told = source.port
    else:
        from mjx_nero.deploy import tags

        camera = None if "://" in args.object else tags.read(pathlib.Path(args.object))
        source = tags.FromTags(camera) if camera else places.of(args.object)
    with contextlib.closing(source):
        point = args.object if constant else None
        with arms.options_of(args, metadata, functools.partial(_world, args, metadata, point), told) as options:
            yield source, options


@contextlib.contextmanager
def pictures_of(args: argparse.Namespace, metadata: dict[str, Any], places: Any) -> Iterator[Any]:
    """Yields the source of the policy's pictures, see ``observe.Pictures``; a policy without cameras gets none.

    Raises:
        UserError: the policy has cameras and nothing provides their pictures, or cameras are given and it has none.
    """
    from mjx_nero.deploy.observe import no_pictures

    told = metadata.get("cameras") or {}
    if not told:
        if args.cameras:
            raise UserError(f"--cameras is for policies with cameras, and {args.policy} has none: leave it out")
        yield no_pictures
        return
    if args.cameras:
        from mjx_nero.deploy import pictures

        source: Any = pictures.Cameras(pictures.read(args.cameras, told), told, float(metadata["control_dt"]))
    elif args.arm == "sim" or args.emulate:
        from mjx_nero.deploy.emulators.eyes import Eyes
        from mjx_nero.sim import scene

        cfg = scene_of(args, metadata)
        model = scene.build(cfg.robot, cfg.scene, cfg.sim, visuals=True)
        source = Eyes(model, told, metadata["joints"]["names"], metadata["base"]["position"], places)
    else:
        raise UserError(f"the policy needs pictures of {' and '.join(told)}: name these cameras in a file with --cameras")
    with contextlib.closing(source):
        yield source


def scene_of(args: argparse.Namespace, metadata: dict[str, Any]) -> Any:
    """Returns the config of the environment that a policy was trained in.

    Raises:
        UserError: ``--robot`` is another robot.
    """
    cfg = _cfg(metadata["env"], metadata["preset"], args.robot)
    if cfg.robot.name != metadata["robot"] or list(cfg.robot.joints) != list(metadata["joints"]["names"]):
        raise UserError(
            f"--robot {args.robot} is {cfg.robot.name}, but the policy was trained with {metadata['robot']}: pass its folder"
        )
    return cfg


def _is_point(text: str) -> bool:
    return "://" not in text and text[:1] in "+-.0123456789" and "," in text


@functools.cache
def _cfg(name: str, preset: str, robot: str | None) -> Any:
    from mjx_nero.tasks import registry

    return registry.env_cfg(name, preset, robot)


def _world(args: argparse.Namespace, metadata: dict[str, Any], point: str | None) -> World:
    cfg = scene_of(args, metadata)
    objects: dict[str, Any] = {}
    for name, item in cfg.scene.objects.items():
        x, y, above = item.pos
        event = next((t for t in cfg.events.values() if t.params.get("object", "cube") == name and "x" in t.params), None)
        if event is not None:
            x, y = (sum(event.params[axis]) / 2 for axis in "xy")
        objects[name] = [x, y, item.rest_height + above]
    if point and objects:
        objects[next(iter(objects))] = arms.numbers(point, (3,), "--object")
    return World(cfg.robot, cfg.scene, cfg.sim, objects)
