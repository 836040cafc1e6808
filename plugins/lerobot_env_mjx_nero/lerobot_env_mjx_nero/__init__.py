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
    """What ``lerobot-train`` and ``lerobot-eval`` take as ``--env.*``.

    Attributes:
        task: an environment of mjx_nero.
        preset: of the environment's presets.
        robot: another than the environment's own, by name or folder.
        units: of joints, as in the data set: auto, si or lerobot.
        through: who made the data set acted through: task (a policy) or drives (an expert), as ``demos --inspect`` says.
        velocities: the state has the joints' velocities, too, as ``demos --velocities``.
        cameras: whose pictures the policy sees, with commas between them, as ``demos --cameras``.
        renderer: of the pictures, as ``demos --renderer``.
        width, height: of a picture [pixels].
        fps: filled in, as are the features: control steps a second.
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
        joints, poses = len(cfg.robot.joints), 1 if self.cameras else 2 + len(cfg.scene.objects)  # who sees is told the goal
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
        """What LeRobot imports if it does not know the environment yet."""
        return __name__

    @property
    def gym_id(self) -> str:
        """What LeRobot hands to ``gymnasium.make``."""
        return GYM_ID

    @property
    def gym_kwargs(self) -> dict:
        """Arguments of ``env.Env``."""
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
