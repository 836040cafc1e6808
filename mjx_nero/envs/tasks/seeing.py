"""A task seen through cameras: what is told of objects is left out, and pictures take its place. Presets ``rgb``, ``depth``,
``rgbd``. A teacher who is told where the objects are shows a student who is not (``learn.distill``).
"""

import dataclasses

from mjx_nero.envs.task import EnvCfg
from mjx_nero.mdp import images, observations
from mjx_nero.mdp.terms import ObservationGroup, ObservationTerm
from mjx_nero.sim.cameras import places
from mjx_nero.types import UserError

SIZE = (64, 64)  # pixels
_READS = {"rgb": (images.rgb, ("rgb",)), "depth": (images.depth, ("depth",)), "rgbd": (images.rgbd, ("rgb", "depth"))}
PRESETS = tuple(_READS)


def seen(cfg: EnvCfg, sees: str = "rgb") -> EnvCfg:
    """The task by pictures of a camera in front and one at the wrist.

    Its observation groups: ``state`` has the robot and the goal alone, ``pictures`` what the cameras see, ``teacher`` what was
    ``state`` before, and ``truth`` where the objects are.

    Args:
        sees: ``rgb``, ``depth`` or ``rgbd``.

    Raises:
        UserError: the scene has no object, or the robot does not say where it works.
    """
    objects = tuple(cfg.scene.objects)
    if not objects:
        raise UserError(f"nothing to see: the scene of {cfg.robot.name} has no object")
    told, (read, kinds) = cfg.observations["state"], _READS[sees]
    cameras = places.find(cfg.robot, SIZE, kinds)
    own = {name: term for name, term in told.terms.items() if not {"object", "objects"} & set(term.params)}
    return dataclasses.replace(
        cfg,
        scene=dataclasses.replace(cfg.scene, cameras=cameras),
        observations={
            "state": dataclasses.replace(told, terms=own),
            "pictures": ObservationGroup({name: ObservationTerm(read, params={"camera": name}) for name in cameras}, apart=True),
            "teacher": dataclasses.replace(told, corruption=False, sensed=False),
            "truth": ObservationGroup(
                {name: ObservationTerm(observations.object_position, params={"object": name}) for name in objects}, sensed=False
            ),
        },
        learner="distill",
    )
