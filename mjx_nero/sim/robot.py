"""Robots: what the model files leave open (mounting, drives, home pose, gripper), as frozen values. The arms are in ``arms``."""

import dataclasses
import pathlib
from collections.abc import Callable

import jax.numpy as jnp

from mjx_nero.bounds import NonNegative, Positive, Range

Box = tuple[Range, Range, Range]  # x, y and z [m]

# In a checkout the assets lie beside the package, in a wheel inside it.
_HERE = pathlib.Path(__file__).resolve().parents[1]
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

    joints: tuple[str, ...] = ()
    stiffness: tuple[Positive, ...] = ()
    damping: tuple[NonNegative, ...] = ()
    effort: tuple[Positive, ...] = ()
    speed: tuple[Positive, ...] = ()
    home: tuple[float, ...] = ()

    @property
    def lead(self) -> tuple[float, ...]:
        """Damping over stiffness [s]. A target this many seconds ahead of a moving set-point makes a drive that damps a joint's
        speed damp its speed error instead: it tracks without lag."""
        return tuple(d / k for d, k in zip(self.damping, self.stiffness, strict=True))


@dataclasses.dataclass(frozen=True)
class GripperCfg(DriveCfg):
    """A gripper: drives with an open and a closed target. Without joints: none.

    Attributes:
        open, close: targets of the two actions [rad] or [m].
        gap: ``positions [n] -> distance between the fingers' pads [m]``, of two opposed slides unless given; None: unknown.
        positions: its inverse.
    """

    open: tuple[float, ...] = ()
    close: tuple[float, ...] = ()
    gap: Callable | None = dataclasses.field(default=lambda q: q[0] - q[1])
    positions: Callable | None = dataclasses.field(default=lambda gap: jnp.stack([gap / 2, -gap / 2]))


@dataclasses.dataclass(frozen=True)
class RobotCfg:
    """A robot.

    Attributes:
        name: folder under ``assets``, holding ``<name>.xml``; or what an imported robot is called.
        base_link: body that is fixed in the world.
        base_pos: where the robot stands in the world [m].
        base_quat: how its base link is turned there, wxyz. Commands and observations use the unturned frame.
        arm, gripper: their drives.
        ee_site: site at the grasp point.
        down: orientation of ``ee_site`` when the gripper points straight down and its fingers open along y, wxyz.
        gravity_compensation: the drives carry the links' weight, as a robot's own controller does; False where the recipe that a
            robot comes from does not.
        max_step: the longest physics step that the drives bear [s]; 0: any that a task has.
        workspace: box of the unturned frame in which ``ee_site`` gets everywhere, ranges of x, y and z [m]; what reach tasks
            command unless they say otherwise.
        floor: height of the floor that a robot beside the table stands on [m]; 0: it stands on the table.
        opening: between the gripper's pads when it is open [m]; 0: unknown.
        pad: size of a pad along the approach, across, and along the opening [m]; zeros: unknown.
        grip: where the middle of a cube is that the gripper holds, in the frame of ``ee_site`` [m].
        pick: box of the unturned frame over the table in which ``ee_site`` gets everywhere with the gripper pointing down, as far
            as the arm can; its lowest height is the one to grasp a cube of the gripper's size at (``sim.grasp``) [m].
        lean: how far from straight down the gripper has to lean somewhere in ``pick`` [rad]; 0: it points down everywhere.
        hold: box of the unturned frame above, to which the gripper can bring what it holds [m]; ``pick`` and ``hold`` are what
            lift commands unless it is told otherwise.
        folder: of an imported robot, holding ``model.xml``; empty: one of the package's.
        mjcf: the model itself, as text in place of a file.
    """

    name: str
    arm: DriveCfg
    gripper: GripperCfg = GripperCfg()
    ee_site: str = "ee"
    base_link: str = "base_link"
    base_pos: tuple[float, float, float] = (0.0, 0.0, 0.0)
    base_quat: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    down: tuple[float, float, float, float] = (0.0, 1.0, 0.0, 0.0)
    gravity_compensation: bool = False
    max_step: NonNegative = 0.0
    workspace: Box | None = None
    floor: float = 0.0
    opening: float = 0.0
    pad: tuple[float, float, float] = (0.0, 0.0, 0.0)
    grip: tuple[float, float, float] = (0.0, 0.0, 0.0)
    pick: Box | None = None
    lean: NonNegative = 0.0
    hold: Box | None = None
    folder: str = ""
    mjcf: str = ""

    @property
    def xml(self) -> pathlib.Path:
        """Path of the model file."""
        return pathlib.Path(self.folder, "model.xml") if self.folder else ASSETS / self.name / f"{self.name}.xml"

    @property
    def joints(self) -> tuple[str, ...]:
        """Joint names, arm first: the order of ``View.joint_pos``, of the actuators and of ``ctrl``."""
        return self.arm.joints + self.gripper.joints

    @property
    def home(self) -> tuple[float, ...]:
        """Home position of all joints [rad, m]."""
        return self.arm.home + self.gripper.home
