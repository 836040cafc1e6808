"""Robots as frozen values: mounting, drives, home pose and gripper, which model files leave open. ``tasks.arms`` has the arms."""

import dataclasses
import pathlib
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp

from mjx_nero.config.bounds import Gap, NonNegative, Place, Places, Point, Positive

Box = tuple[Places, Places, Places]  # x, y and z [m]

# In a checkout the assets lie beside the package, in a wheel inside it.
_HERE = pathlib.Path(__file__).resolve().parents[1]
ASSETS = next(d for d in (_HERE / "assets", _HERE.parent / "assets") if d.is_dir())


@dataclasses.dataclass(frozen=True)
class DriveCfg:
    """PD position drives of a group of joints. All tuples have the order of ``joints``.

    Attributes:
        joints: names of the joints in the model.
        stiffness: [N m/rad] or [N/m].
        damping: [N m s/rad] or [N s/m].
        effort: force limits [N m] or [N].
        speed: speed limits of the position targets [rad/s] or [m/s].
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
        """Damping over stiffness [s].

        A drive damps a joint's speed, so it lags behind a moving set-point. A target ``lead`` seconds ahead makes it damp the
        speed error instead, and it tracks without lag.
        """
        return tuple(d / k for d, k in zip(self.damping, self.stiffness, strict=True))


def slides_gap(positions: Any) -> Any:
    """Distance between the pads of two opposed slides [m], from their positions [m]."""
    return positions[0] - positions[1]


def slides_positions(gap: Any) -> Any:
    """The inverse of ``slides_gap``."""
    return jnp.stack([gap / 2, -gap / 2])


@dataclasses.dataclass(frozen=True)
class GripperCfg(DriveCfg):
    """Drives with an open and a closed target. Without a gripper, it has no joints.

    Attributes:
        open: targets that open the gripper [rad] or [m].
        close: targets that close the gripper [rad] or [m].
        gap: ``positions [n] -> distance between the fingers' pads [m]``; None: unknown. The default suits two opposed slides.
        positions: inverse of ``gap``.
    """

    open: tuple[float, ...] = ()
    close: tuple[float, ...] = ()
    gap: Callable | None = dataclasses.field(default=slides_gap)
    positions: Callable | None = dataclasses.field(default=slides_positions)


@dataclasses.dataclass(frozen=True)
class RobotCfg:
    """A robot.

    Attributes:
        name: name of an imported robot, or of a folder under ``assets`` that holds ``<name>.xml``.
        base_link: body that is fixed in the world.
        base_pos: place of the base link in the world [m].
        base_quat: orientation of the base link, wxyz. Commands and observations use the frame before this rotation.
        arm, gripper: drives.
        ee_site: site at the grasp point.
        down: orientation of ``ee_site`` when the gripper points straight down and its fingers open along y, wxyz.
        gravity_compensation: True: the drives carry the links' weight, as most robots' own controllers do. False: they do not, as
            in some recipes.
        max_step: longest physics step at which the drives are stable [s]; 0: no limit.
        workspace: box that ``ee_site`` can reach everywhere, ranges of x, y and z in the unrotated base frame [m]. Reach tasks
            draw their commands from it by default.
        floor: height of the floor under a robot beside the table [m]; 0: the robot stands on the table.
        opening: distance between the pads of the open gripper, along the line on which the pads close [m]; 0: unknown.
        closed: distance between the pads of the closed gripper [m].
        pad: size of a pad along the approach, across it, and along the opening [m]; zeros: unknown.
        grip: centre of a held cube in the frame of ``ee_site`` [m].
        pick: box over the table that ``ee_site`` can reach everywhere with the gripper pointing down (see ``lean``), in the
            unrotated base frame [m]. Its lowest height is the grasp height of a cube that fits the gripper (``sim.grasp``).
        lean: largest angle from straight down that the gripper needs in ``pick`` [rad]; 0: it points down everywhere.
        turns: True: everywhere in ``pick`` the gripper can turn about the vertical so that its fingers open along y.
        hold: box above ``pick`` to which the gripper can bring an object, in the unrotated base frame [m]. Lift tasks draw their
            objects from ``pick`` and their goals from ``hold`` by default.
        folder: folder of an imported robot, which holds ``model.xml``; empty for the package's own.
        mjcf: text of the model, in place of a file.
    """

    name: str
    arm: DriveCfg
    gripper: GripperCfg = GripperCfg()
    ee_site: str = "ee"
    base_link: str = "base_link"
    base_pos: Point = (0.0, 0.0, 0.0)
    base_quat: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    down: tuple[float, float, float, float] = (0.0, 1.0, 0.0, 0.0)
    gravity_compensation: bool = False
    max_step: NonNegative = 0.0
    workspace: Box | None = None
    floor: Place = 0.0
    opening: Gap = 0.0
    closed: Gap = 0.0
    pad: tuple[Gap, Gap, Gap] = (0.0, 0.0, 0.0)
    grip: Point = (0.0, 0.0, 0.0)
    pick: Box | None = None
    lean: NonNegative = 0.0
    turns: bool = True
    hold: Box | None = None
    folder: str = ""
    mjcf: str = ""

    @property
    def xml(self) -> pathlib.Path:
        """Path of the model file."""
        return pathlib.Path(self.folder, "model.xml") if self.folder else ASSETS / self.name / f"{self.name}.xml"

    @property
    def joints(self) -> tuple[str, ...]:
        """Joint names, arm first. ``View.joint_pos``, the actuators and ``ctrl`` have this order."""
        return self.arm.joints + self.gripper.joints

    @property
    def home(self) -> tuple[float, ...]:
        """Home position of all joints [rad, m]."""
        return self.arm.home + self.gripper.home
