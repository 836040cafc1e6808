"""Fixtures: things that stand in a scene, such as cabinets. Their models come from files, and may have joints that move.

A fixture's joints are part of ``qpos``. Where it stands differs from episode to episode, so it is a model field of each world.
"""

import dataclasses
import functools
import pathlib
from collections.abc import Callable, Mapping

import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from mjx_nero import math
from mjx_nero.config.bounds import Point
from mjx_nero.config.values import hint, short
from mjx_nero.sim import linkage, model_file, quats
from mjx_nero.sim.kinematics import Chain
from mjx_nero.sim.parts import Fields, Part
from mjx_nero.sim.robot import ASSETS
from mjx_nero.types import Carry, FixtureStart, FixtureView, Sim, Start, UserError, View

FOLDER, MODEL = ASSETS / "fixtures", "model.xml"
FIELDS = ("body_pos", "body_quat")
MEETS = 2 | 4  # contact bits: a robot's hand and palm, and objects
_HOLDER = "fixtures"  # the body that carries all of them


@dataclasses.dataclass(frozen=True)
class FixtureCfg:
    """A thing that stands in the scene, with joints of its own or at least a site.

    Attributes:
        file: a fixture of the package by name (``assets/fixtures``), or a folder with ``model.xml``, MJCF as in a robot's folder.
        pos: place of the fixture's origin in the world, before the reset events [m].
        quat: orientation before the reset events, wxyz.
    """

    file: str = "cabinet"
    pos: Point = (0.5, 0.0, 0.0)
    quat: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)


def own() -> tuple[str, ...]:
    """Lists the names of the package's own fixtures."""
    return tuple(sorted(path.parent.name for path in FOLDER.glob(f"*/{MODEL}")))


def read(file: str) -> mujoco.MjSpec:
    """Reads a fixture's model, with the limits for untrusted robots.

    Raises:
        UserError: there is no such file, it is damaged, or it holds something that a fixture cannot have.
    """
    folder = FOLDER / file if file in own() else pathlib.Path(file)
    if not (folder / MODEL).is_file():
        names = own()
        raise UserError(
            f"no fixture {short(file)}{hint(file, names)}: choose one of {', '.join(names)}, or give a folder with {MODEL}"
        )
    spec, where = model_file.read(folder / MODEL), folder / MODEL
    if not spec.joints and not spec.sites:
        raise UserError(
            f"{where} has no joint that moves, and no site: a thing that stands still is an obstacle (scene.obstacles)"
        )
    if unnamed := [joint for joint in spec.joints if not joint.name]:
        raise UserError(f"{where}: a joint of body {unnamed[0].parent.name!r} has no name: give it one")
    return spec


@functools.lru_cache(maxsize=16)
def chain(file: str) -> Chain:
    """Returns the poses of a fixture's sites in its own frame as a function of its joints; coupled joints follow.

    Raises:
        UserError: as ``read``, or the model does not compile.
    """
    try:
        model = read(file).compile()
    except ValueError as error:
        raise UserError(f"the fixture {short(file)} is not a valid model: {error}") from None
    followers = {coupling.follower for coupling in linkage.couplings(model)}
    free = [model.joint(j).name for j in range(model.njnt) if int(model.jnt_qposadr[j]) not in followers]
    return Chain(model, free, [model.site(i).name for i in range(model.nsite)])


def at_rest(file: str, site: str) -> tuple[np.ndarray, np.ndarray]:
    """Returns position [m] and orientation (wxyz) of a fixture's site in its own frame, all joints at rest.

    Raises:
        KeyError: there is no such site.
    """
    model = read(file).compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return data.site(site).xpos.copy(), quats.of_matrix(data.site(site).xmat)


def add(spec: mujoco.MjSpec, fixtures: Mapping[str, FixtureCfg], visuals: bool = True) -> None:
    """Adds fixtures to a scene. Everything of fixture ``name`` is called ``name/...`` there.

    Geoms that collide in the fixture's file collide with hands and with objects, but never within the fixture. Without
    ``visuals`` all other geoms are left out.

    Raises:
        UserError: as ``read``, or a name is taken.
    """
    if not fixtures:
        return
    # On a movable body: MuJoCo Warp assumes that bodies fixed to the world never move.
    holder = spec.worldbody.add_body(name=_HOLDER, mocap=True)
    for name, cfg in fixtures.items():
        if spec.body(name) or "/" in name:
            raise UserError(f"scene.fixtures.{name} needs another name: it is taken, or has a slash")
        model = read(cfg.file)
        for geom in model.geoms:
            collides = geom.contype or geom.conaffinity
            geom.contype, geom.conaffinity = MEETS if collides else 0, 0
        if not visuals:
            model.discard_visual()
        body = holder.add_body(name=name, pos=cfg.pos, quat=cfg.quat)
        spec.attach(model, prefix=f"{name}/", frame=body.add_frame())


class Fixtures(Part):
    """The fixtures of a scene.

    Args:
        model: compiled scene.
        cfg: the scene's fixtures by name.
        drawn: makes the scene's model for pictures.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        cfg: Mapping[str, FixtureCfg],
        drawn: Callable[[], mujoco.MjModel] | None = None,
    ):
        self._drawn = drawn
        self.fields = self.seen = FIELDS if cfg else ()
        self._rows = {name: int(model.body(name).id) for name in cfg}
        self._chains = {name: chain(each.file) for name, each in cfg.items()}
        self._joints = {name: [model.joint(f"{name}/{j}") for j in self._chains[name].joints] for name in cfg}
        self._nominal = {field: np.array(getattr(model, field), np.float32) for field in (*FIELDS, "jnt_range")}
        self._qpos0 = np.array(model.qpos0, np.float32)

    def blank(self) -> dict[str, dict[str, FixtureStart]]:
        """Returns where the fixtures are before any reset event."""
        return {"fixtures": {name: self._start(name, row) for name, row in self._rows.items()}}

    def _start(self, name: str, row: int) -> FixtureStart:
        pos, quat = (self._nominal[field] for field in FIELDS)
        return FixtureStart(
            pos_w=jnp.asarray(pos[row]),
            quat_w=jnp.asarray(quat[row]),
            joint_pos={
                joint: jnp.asarray(self._qpos0[int(at.qposadr[0])])
                for joint, at in zip(self._chains[name].joints, self._joints[name], strict=True)
            },
        )

    def start(self, view: View, carry: Carry) -> dict[str, dict[str, FixtureStart]]:
        """Returns where the fixtures and their joints are."""
        return {"fixtures": {name: FixtureStart(at.pos_w, at.quat_w, at.joint_pos) for name, at in view.fixtures.items()}}

    def given(self, start: Start) -> Fields:
        """Returns the fields that say where the fixtures stand."""
        pos, quat = (jnp.asarray(self._nominal[field]) for field in FIELDS)
        for name, row in self._rows.items():
            seen = start.fixtures[name]
            pos, quat = pos.at[row].set(seen.pos_w), quat.at[row].set(seen.quat_w)
        return dict(zip(FIELDS, (pos, quat), strict=True)) if self._rows else {}

    def qpos(self, qpos: Float[Array, " nq"], start: Start, fields: Fields) -> Float[Array, " nq"]:
        """Puts the fixtures' joints where they begin, within their ranges."""
        for name, joints in self._joints.items():
            ranges = self._ranges(name, fields)
            for joint, at in zip(self._chains[name].joints, joints, strict=True):
                qpos = qpos.at[int(at.qposadr[0])].set(jnp.clip(start.fixtures[name].joint_pos[joint], *ranges[joint]))
        return qpos

    def view(self, sim: Sim, carry: Carry) -> dict[str, dict[str, FixtureView]]:
        """Returns ``fixtures`` of a view."""
        return {"fixtures": {name: self._view(name, sim.qpos, sim.qvel, sim.fields) for name in self._rows}}

    def scenery(self, sim: Sim, carry: Carry, look: Fields) -> dict[str, Fields]:
        """Returns the fields of the drawn model with the fixtures where they stand."""
        if not self._rows or not self._drawn:
            return {}
        model, out = self._drawn(), dict(look)
        for field in FIELDS:
            out[field] = jnp.asarray(getattr(model, field), jnp.float32)
            for name, row in self._rows.items():
                out[field] = out[field].at[model.body(name).id].set(sim.fields[field][row])
        return {"look": out}

    def _view(self, name: str, qpos: Array, qvel: Array, fields: Mapping[str, Array]) -> FixtureView:
        found, joints, row = self._chains[name], self._joints[name], self._rows[name]
        base, turn = (jnp.asarray(fields.get(field, self._nominal[field]))[row] for field in FIELDS)
        q = qpos[np.array([int(at.qposadr[0]) for at in joints], int)]
        speed = qvel[np.array([int(at.dofadr[0]) for at in joints], int)]
        pos, quat = found.poses(q) if found.frames else (jnp.zeros((0, 3)), jnp.zeros((0, 4)))
        sites = range(len(found.frames))
        return FixtureView(
            pos_w=base,
            quat_w=turn,
            joint_pos={joint: q[i] for i, joint in enumerate(found.joints)},
            joint_vel={joint: speed[i] for i, joint in enumerate(found.joints)},
            joint_range=self._ranges(name, fields),
            site_pos_w={found.frames[i]: base + math.rotate(turn, pos[i]) for i in sites},
            site_quat_w={found.frames[i]: math.quat_mul(turn, quat[i]) for i in sites},
        )

    def _ranges(self, name: str, fields: Mapping[str, Array]) -> dict[str, Float[Array, "2"]]:
        """Ranges of a fixture's joints; a joint without limits has an infinite one."""
        now, found = jnp.asarray(fields.get("jnt_range", self._nominal["jnt_range"])), self._chains[name]
        ranges = [
            now[at.id] if low > -np.inf else jnp.array([-np.inf, np.inf])
            for at, low in zip(self._joints[name], found.lower, strict=True)
        ]
        return dict(zip(found.joints, ranges, strict=True))
