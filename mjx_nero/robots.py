"""Robots: what the model files leave open (mounting, drives, home pose, gripper), as frozen values."""

import dataclasses
import pathlib
from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array, Float

# In a checkout the assets lie beside the package, in a wheel inside it.
_HERE = pathlib.Path(__file__).resolve().parent
ASSETS = next(d for d in (_HERE / "assets", _HERE.parent / "assets") if d.is_dir())


@dataclasses.dataclass(frozen=True)
class DriveCfg:
    """PD position drives of a group of joints; tuples run along ``joints``.

    Attributes:
        joints: names in the model.
        stiffness: [N m/rad] or [N/m].
        damping: [N m s/rad] or [N s/m].
        effort: limits of the drives' forces [N m] or [N].
        speed: limits of how fast the position targets move [rad/s] or [m/s].
        home: joint positions at reset and at action zero [rad] or [m].
    """

    joints: tuple[str, ...]
    stiffness: tuple[float, ...]
    damping: tuple[float, ...]
    effort: tuple[float, ...]
    speed: tuple[float, ...]
    home: tuple[float, ...]

    @property
    def lead(self) -> tuple[float, ...]:
        """Damping over stiffness [s]. A target this many seconds ahead of a moving set-point makes a drive that damps a joint's
        speed damp its speed error instead: it tracks without lag."""
        return tuple(d / k for d, k in zip(self.damping, self.stiffness, strict=True))


@dataclasses.dataclass(frozen=True)
class GripperCfg(DriveCfg):
    """A parallel gripper: drives with an open and a closed target.

    Attributes:
        gap: ``positions [n] -> distance between the fingers' pads [m]``.
        positions: its inverse.
    """

    open: tuple[float, ...] = ()
    close: tuple[float, ...] = ()
    gap: Callable = dataclasses.field(default=lambda q: q[0] - q[1])
    positions: Callable = dataclasses.field(default=lambda gap: jnp.stack([gap / 2, -gap / 2]))


# OnRobot RG6: parallel cranks of 80 mm (assets/cobotta_pro_900/README.md).
_CRANK, _CLOSED_ANGLE, _OFFSET = 0.08, 0.6331, 0.000488


def rg6_gap(q: Float[Array, "2"]) -> Float[Array, ""]:
    """Distance between the pads [m] at the two driven joints' positions [rad]; 0 to 0.151."""
    left, right = (_CRANK * jnp.sin(_CLOSED_ANGLE - angle) - _OFFSET for angle in (q[0], -q[1]))
    return left + right


def rg6_positions(gap: Float[Array, ""]) -> Float[Array, "2"]:
    """Positions of the two driven joints [rad] that leave ``gap`` [m] between the pads."""
    q = _CLOSED_ANGLE - jnp.arcsin((gap / 2 + _OFFSET) / _CRANK)
    return jnp.stack([q, -q])


@dataclasses.dataclass(frozen=True)
class RobotCfg:
    """A robot of the package.

    Attributes:
        name: folder under ``assets``, holding ``<name>.xml``.
        base_pos: where the robot stands in the world [m].
        base_quat: how its base link is turned there, wxyz. Commands and observations use the unturned frame.
        ee_site: site at the grasp point.
        down: orientation of ``ee_site`` when the gripper points straight down and its fingers open along y, wxyz.
        gravity_compensation: the drives carry the links' weight, as a robot's own controller does; False where the recipe that a
            robot comes from does not.
    """

    name: str
    arm: DriveCfg
    gripper: GripperCfg
    ee_site: str = "ee"
    base_link: str = "base_link"
    base_pos: tuple[float, float, float] = (0.0, 0.0, 0.0)
    base_quat: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    down: tuple[float, float, float, float] = (0.0, 1.0, 0.0, 0.0)
    gravity_compensation: bool = False

    @property
    def xml(self) -> pathlib.Path:
        """Path of the model file."""
        return ASSETS / self.name / f"{self.name}.xml"

    @property
    def joints(self) -> tuple[str, ...]:
        """Joint names, arm first: the order of ``View.joint_pos``, of the actuators and of ``ctrl``."""
        return self.arm.joints + self.gripper.joints

    @property
    def home(self) -> tuple[float, ...]:
        """Home position of all joints [rad, m]."""
        return self.arm.home + self.gripper.home


# Drives and home pose: the Isaac Lab recipe for the Nero lift. Its soft limit factor (0.9) is read by no term of the
# task and would exclude the recipe's own home (joint4 = 2.0), so targets are limited by the joint ranges alone.
NERO = RobotCfg(
    name="nero",
    # Half a turn: positive joint4 folds the forearm towards -x of the base, and the work lies at +x (assets/nero/README.md).
    base_quat=(0.0, 0.0, 0.0, 1.0),
    arm=DriveCfg(
        joints=("joint1", "joint2", "joint3", "joint4", "joint5", "joint6", "joint7"),
        stiffness=(200.0, 170.0, 120.0, 80.0, 50.0, 20.0, 10.0),
        damping=(100.0, 60.0, 70.0, 24.0, 20.0, 10.0, 5.0),
        effort=(25.0,) * 7,
        speed=(1.5,) * 7,
        home=(0.0, 0.0, 0.0, 2.0, 0.0, 0.0, 0.0),
    ),
    gripper=GripperCfg(
        joints=("gripper_joint1", "gripper_joint2"),
        stiffness=(800.0, 800.0),
        damping=(20.0, 20.0),
        effort=(22.0, 22.0),
        speed=(1.5, 1.5),
        home=(0.05, -0.05),
        open=(0.05, -0.05),
        close=(0.0, -0.001),
    ),
)

# Stiffness and damping: critical damping at home, from measured step responses (assets/cobotta_pro_900/README.md). Speeds: a
# collaborative half of the published ones. Home: the grasp point at (0.5, 0, 0.28), straight down, fingers opening along y.
COBOTTA_PRO_900 = RobotCfg(
    name="cobotta_pro_900",
    down=(0.0, 0.0, 1.0, 0.0),
    gravity_compensation=True,
    arm=DriveCfg(
        joints=("joint_1", "joint_2", "joint_3", "joint_4", "joint_5", "joint_6"),
        stiffness=(2000.0, 2000.0, 1500.0, 300.0, 300.0, 100.0),
        damping=(180.0, 190.0, 95.0, 19.0, 16.0, 6.5),
        effort=(200.0, 200.0, 120.0, 50.0, 50.0, 30.0),
        speed=(2.0,) * 6,
        home=(-0.24237, 0.18845, 1.41048, 0.0, 1.54266, -0.24237),
    ),
    # The tutorial's two driven joints. The linkage couples all six, so they share the load.
    gripper=GripperCfg(
        joints=("finger_joint", "right_outer_knuckle_joint"),
        stiffness=(20.0, 20.0),
        damping=(1.0, 1.0),
        effort=(2.3, 2.3),  # 30 N a finger at a 51.5 mm grip: within the gripper's 25 to 120 N
        speed=(0.9, 0.9),  # the gap at the gripper's top speed, 135 mm/s
        home=(0.0, 0.0),
        open=(0.0, 0.0),
        close=(0.628, -0.628),
        gap=rg6_gap,
        positions=rg6_positions,
    ),
)
