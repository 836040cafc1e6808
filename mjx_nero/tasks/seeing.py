"""Tasks seen through cameras: pictures replace the observations of objects.

The presets are ``rgb``, ``depth`` and ``rgbd``, each also with the suffix ``_fixed``; lifts also have ``sim2real_rgb``. A teacher
that observes the objects' positions trains a student that does not (``imitation.distill``).
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping

from mjx_nero.config.bounds import Range
from mjx_nero.envs import regions
from mjx_nero.envs.task import Budget, EnvCfg, Presets
from mjx_nero.mdp import images, looks, observations
from mjx_nero.mdp.terms import ObservationGroup, ObservationTerm, Term
from mjx_nero.sim.cameras import drawn, places
from mjx_nero.sim.robot import Box, RobotCfg
from mjx_nero.types import UserError

SIZE = (64, 64)  # pixels
DISTRACTORS = 6
PATTERNS = 12  # of ``lifelike``
STEPS, STEPS_ON_CPU = 20_000_000, 200_000  # env steps of a training run
_READS = {"rgb": (images.rgb, ("rgb",)), "depth": (images.depth, ("depth",)), "rgbd": (images.rgbd, ("rgb", "depth"))}
_OF_EXPERTS = ("imitation", "critic_first")
FIXED = "_fixed"  # suffix of a preset whose episodes all look the same
PRESETS = (*_READS, *(name + FIXED for name in _READS))


def presets(task: Callable[[RobotCfg], EnvCfg], goal: Mapping[str, ObservationTerm] | None = None) -> Presets:
    """Lists ``PRESETS`` of a task for any robot. ``goal`` as in ``seen``."""

    def made(robot: RobotCfg, sees: str) -> EnvCfg:
        return seen(task(robot), sees, goal)

    return {name: functools.partial(made, sees=name) for name in PRESETS}


def seen(cfg: EnvCfg, sees: str = "rgb", goal: Mapping[str, ObservationTerm] | None = None) -> EnvCfg:
    """Returns the task with a camera in front and one at the wrist.

    The observation group ``state`` has only the robot and the goal, ``pictures`` the cameras' pictures, ``teacher`` what
    ``state`` was before, and ``truth`` the positions of objects.

    Args:
        sees: one of ``PRESETS``.
        goal: terms that tell the student its goal, which no picture shows, if the task gives it only relative to an object.

    Raises:
        UserError: the scene has no object, or the robot's config lacks the region where it works.
    """
    objects = tuple(cfg.scene.objects)
    if not objects:
        raise UserError(f"nothing to see: the scene of {cfg.robot.name} has no object")
    told, (read, kinds) = cfg.observations["state"], _READS[sees.removesuffix(FIXED)]
    cameras = places.find(cfg.robot, SIZE, kinds)
    own = {name: term for name, term in told.terms.items() if not {"object", "objects"} & set(term.params)}
    cfg = dataclasses.replace(
        cfg,
        scene=dataclasses.replace(cfg.scene, cameras=cameras),
        observations={
            "state": dataclasses.replace(told, terms={**own, **(goal or {})}),
            "pictures": ObservationGroup({name: ObservationTerm(read, params={"camera": name}) for name in cameras}, apart=True),
            "teacher": dataclasses.replace(told, corruption=False, sensed=False),
            "truth": ObservationGroup(
                {name: ObservationTerm(observations.object_position, params={"object": name}) for name in objects}, sensed=False
            ),
        },
        learner="distill",
        # PPO's settings, without those that need an expert: its steps have no pictures.
        training={name: value for name, value in cfg.training.items() if name not in _OF_EXPERTS},
        budget=Budget(steps=STEPS, steps_on_cpu=STEPS_ON_CPU),
    )
    return cfg if sees.endswith(FIXED) else randomized(cfg)


def randomized(cfg: EnvCfg) -> EnvCfg:
    """Makes every episode of a task with cameras look different.

    Each range is a field of its own (``--env.look.lights.params.brightness "(0.3, 2)"``, ``--env.sensors.front.params.noise 8``).
    """
    scene = dataclasses.replace(cfg.scene, distractors=DISTRACTORS, backdrop=True)
    names, objects, there = (
        drawn.distractors(scene),
        tuple(scene.objects),
        regions.box(cfg.robot, "pick", "where on the table it can grasp"),
    )
    any_color = {"change": 1.0, "shade": (0.3, 1.2)}
    poses = {
        f"{name}_pose": Term(
            looks.camera_pose, params={"cameras": (name,), "offset": 0.02 if not c.link else 0.005, "turn": 0.04}
        )
        for name, c in scene.cameras.items()
    }
    beside = {
        f"props_{side}": Term(
            looks.places, params={"geoms": names[i::2], **_beside(there, cfg.robot.base_pos, side), "there": 0.6}
        )
        for i, side in enumerate(("left", "right"))
    }
    lens = {"exposure": (0.7, 1.3), "white_balance": 0.1, "blur": 0.5, "noise": 4.0, "delay": (0, 1), "hold": 0.9}
    lens |= {"depth_noise": 0.005, "depth_step": 0.001, "holes": 0.02}
    return dataclasses.replace(
        cfg,
        scene=scene,
        look={
            **cfg.look,
            **poses,
            "fovy": Term(looks.camera_fovy, params={"cameras": tuple(scene.cameras), "scale": (0.95, 1.05)}),
            "lights": Term(looks.lights, params={"turn": 0.5, "brightness": (0.4, 1.4), "tint": 0.15, "dark": 0.2}),
            "table": Term(looks.colors, params={"geoms": ("table_top",), **any_color}),
            "backdrop": Term(looks.colors, params={"geoms": ("backdrop",), **any_color}),
            "robot": Term(looks.materials, params={"change": 0.3, "shade": (0.6, 1.3)}),
            "objects": Term(looks.colors, params={"geoms": objects, "change": 0.15, "shade": (0.7, 1.2)}),
            "props_color": Term(looks.colors, params={"geoms": names, **any_color}),
            "props_size": Term(looks.sizes, params={"geoms": names, "scale": (0.4, 1.5)}),
            **beside,
            # Last, so that scenes without photographs and patterns look as they did before there were any.
            "backdrop_photograph": Term(looks.photographs, params={"geoms": ("backdrop",), "share": 0.8}),
            "table_photograph": Term(looks.photographs, params={"geoms": ("table_top",), "share": 0.3}),
            "table_pattern": Term(looks.patterns, params={"geoms": ("table_top",), "share": 0.5}),
            "objects_pattern": Term(looks.patterns, params={"geoms": objects, "share": 0.3}),
            "props_pattern": Term(looks.patterns, params={"geoms": names, "share": 0.5}),
            "robot_pattern": Term(looks.patterns, params={"share": 0.3}),
        },
        sensors={**cfg.sensors, **{f"lens_{name}": Term(images.Lens, params={"camera": name, **lens}) for name in scene.cameras}},
    )


def lifelike(cfg: EnvCfg) -> EnvCfg:
    """Returns a task of ``tasks.sim2real`` seen through cameras: with its differences, a random look, and patterns on everything.

    It has no curriculum, because the teacher has mastered the full task from the start.
    """
    objects, curriculum = cfg.scene.objects, dataclasses.replace(cfg.curriculum, levels=None)
    told = {name: term for name, term in cfg.sensors.items() if name not in objects}  # the policy is not told where objects are
    cfg = seen(dataclasses.replace(cfg, sensors=told, curriculum=curriculum))
    budget = dataclasses.replace(cfg.budget, steps=3 * STEPS)
    return dataclasses.replace(cfg, scene=dataclasses.replace(cfg.scene, patterns=PATTERNS), budget=budget)


def _beside(there: Box, base: tuple[float, float, float], side: str) -> dict[str, Range]:
    """A region of the table, in the world, beside the one where objects are."""
    (low_x, high_x), (low, high), _ = there
    y = (high + 0.06, high + 0.3) if side == "left" else (low - 0.3, low - 0.06)
    return {"x": (base[0] + low_x - 0.15, base[0] + high_x + 0.15), "y": (base[1] + y[0], base[1] + y[1]), "z": (0.0, 0.03)}
