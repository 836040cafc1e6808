"""Environments of mjx_nero for LeRobot: importing this package registers ``--env.type=mjx_nero``."""

from dataclasses import dataclass, field

import gymnasium
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_IMAGES, OBS_STATE

from mjx_nero.tasks import registry

GYM_ID = "lerobot_env_mjx_nero/mjx_nero-v0"


@EnvConfig.register_subclass("mjx_nero")
@dataclass
class MjxNeroEnv(EnvConfig):
    """The ``--env.*`` options of ``lerobot-train`` and ``lerobot-eval``.

    Attributes:
        task: name of an environment of mjx_nero.
        preset: name of one of its presets.
        robot: name of another robot, or folder of an imported one; None: the environment's own.
        units: units of joints, as in the data set: auto, si or lerobot.
        through: what the data set's actions went through, as in ``demos --inspect``: task (a policy's) or drives (an expert's).
        velocities: include the joints' velocities in the state, as ``demos --velocities`` does.
        cameras: comma-separated names of the cameras whose pictures the policy sees, as in ``demos --cameras``.
        renderer: renderer of the pictures, as in ``demos --renderer``.
        width, height: size of a picture [pixels].
        fps: control steps per second; filled in, like the features.
    """

    task: str | None = "nero_lift"
    preset: str = "default"
    robot: str | None = None
    units: str = "auto"
    through: str = "task"
    velocities: bool = False
    cameras: str = ""
    renderer: str = "auto"
    width: int = 64
    height: int = 64
    fps: int = 0
    features: dict[str, PolicyFeature] = field(default_factory=dict)
    features_map: dict[str, str] = field(
        default_factory=lambda: {ACTION: ACTION, "agent_pos": OBS_STATE, "environment_state": OBS_ENV_STATE}
    )

    def __post_init__(self) -> None:
        cfg = registry.env_cfg(self.task, self.preset, self.robot)
        joints, poses = (
            len(cfg.robot.joints),
            1 if self.cameras else 2 + len(cfg.scene.objects),
        )  # with cameras, only the goal's pose
        self.fps = round(1 / (cfg.sim.dt * cfg.sim.decimation))
        self.features = {
            ACTION: PolicyFeature(type=FeatureType.ACTION, shape=(joints,)),
            "agent_pos": PolicyFeature(type=FeatureType.STATE, shape=(joints * (1 + self.velocities),)),
            "environment_state": PolicyFeature(type=FeatureType.ENV, shape=(7 * poses,)),
        }
        for name in filter(None, self.cameras.split(",")):
            width = self.width * len(name.split("+"))  # pictures side by side
            self.features[f"pixels/{name}"] = PolicyFeature(type=FeatureType.VISUAL, shape=(self.height, width, 3))
            self.features_map[f"pixels/{name}"] = f"{OBS_IMAGES}.{name}"

    @property
    def package_name(self) -> str:
        """The package that LeRobot imports if it does not know the environment yet."""
        return __name__

    @property
    def gym_id(self) -> str:
        """The id that LeRobot passes to ``gymnasium.make``."""
        return GYM_ID

    @property
    def gym_kwargs(self) -> dict:
        """The arguments of ``env.Env``."""
        size = (self.width, self.height)
        return {
            "task": self.task,
            "preset": self.preset,
            "robot": self.robot,
            "units": self.units,
            "through": self.through,
            "velocities": self.velocities,
            "cameras": self.cameras,
            "renderer": self.renderer,
            "size": size,
        }


if GYM_ID not in gymnasium.registry:
    gymnasium.register(id=GYM_ID, entry_point=f"{__name__}.env:Env")
