"""Cameras: what they see, by both renderers, and what they cost where nobody looks."""

import dataclasses
import math
import os
import pathlib
import re
import subprocess
import sys

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import mjx_nero
from mjx_nero.mdp import images
from mjx_nero.mdp.terms import ObservationGroup, ObservationTerm
from mjx_nero.sim import cameras, quats, scene
from mjx_nero.sim.cameras import opengl, places
from mjx_nero.sim.cameras.cfg import KINDS, MARK, CameraCfg
from mjx_nero.tasks import registry
from mjx_nero.tools.inspection import report
from mjx_nero.types import Scenery, UserError

# Straight above the cube, which is 3 cm wide and lies at (0.35, 0.1), 64 pixels over 8 degrees from a metre above the table.
ABOVE = CameraCfg(pos=(0.35, 0.1, 1.0), quat=(1.0, 0.0, 0.0, 0.0), fovy=8.0, kinds=KINDS)
TOUCHING = dataclasses.replace(ABOVE, pos=(0.35, 0.1, 0.035), fovy=60.0)  # 5 mm above the cube, as a wrist's over what is held


def with_cameras(found, **fields):
    cfg = registry.env_cfg("nero_lift")
    return dataclasses.replace(cfg, scene=dataclasses.replace(cfg.scene, cameras=found, **fields))


@pytest.fixture(scope="module")
def worlds():
    """Three worlds of a Nero with a cube: qpos [3, nq], and pictures of four cameras."""
    cfg = with_cameras({"above": ABOVE, "touching": TOUCHING, **places.find(registry.robot("nero"), (48, 36), KINDS)})
    model, rng = scene.build(cfg.robot, cfg.scene, cfg.sim), np.random.default_rng(0)
    qpos = np.tile(model.qpos0, (3, 1))
    joints = [model.joint(name).qposadr[0] for name in cfg.robot.joints]
    qpos[:, joints] = np.array(cfg.robot.home)
    qpos[1:, joints[:7]] += rng.uniform(-0.3, 0.3, (2, 7))
    qpos[0, joints[0]] = 2.0  # out of the way
    at = model.joint("cube").qposadr[0]
    qpos[:, at : at + 3] = (0.35, 0.1, 0.015)

    def draw(renderer):
        eyes = cameras.Cameras(model, cfg.scene.cameras, renderer)
        unseen = Scenery(jnp.array([[0.35, 0.1, 0.3]] * 3), jnp.ones((3, 4)))  # the goal's marker, between camera and cube
        return jax.jit(jax.vmap(eyes))(jnp.asarray(qpos, jnp.float32), unseen)

    return model, {name: jax.device_get(draw(name)) for name in ("mujoco", "warp")}


def test_without_warp_mujoco_draws(monkeypatch):
    """Also with physics that would draw by Warp, and for a command that only looks."""
    monkeypatch.setitem(sys.modules, "warp", None)
    monkeypatch.setattr(cameras.importlib.util, "find_spec", lambda name: None)
    assert [cameras.renderer("auto", impl) for impl in ("jax", "native")] == ["mujoco", "mujoco"]
    assert report.inspect("nero_lift", preset="rgb").task.observations["pictures"]["front"] == 64 * 64 * 3
    with pytest.raises(UserError, match=r"^the renderer warp needs the extra cuda .*: use mujoco or auto here$"):
        mjx_nero.make("nero_lift", "rgb", impl="native", **{"scene.renderer": "warp"}).cameras  # noqa: B018


@pytest.mark.parametrize("renderer", ["mujoco", "warp"])
def test_a_camera_above_a_cube_sees_its_top(worlds, renderer):
    model, drawn = worlds
    seen = drawn[renderer]["above"]
    cube = seen.segmentation[0] == model.geom("cube").id
    edge = 64 * 0.03 / (2 * 0.97 * math.tan(math.radians(4)))  # of the top, 0.97 m away [pixels]
    assert cube.sum() == pytest.approx(edge**2, rel=0.1)
    rows, columns = np.nonzero(cube)
    assert rows.mean() == pytest.approx(31.5, abs=1) and columns.mean() == pytest.approx(31.5, abs=1)
    np.testing.assert_allclose(np.median(seen.depth[0][cube]), 0.97, atol=2e-3)
    np.testing.assert_allclose(seen.depth[0][0, 0], 1.0005, atol=3e-3)  # the table's top is drawn half a millimetre lower
    red, green, blue = seen.rgb[0][cube].mean(0)
    assert red > 1.3 * green and red > 1.3 * blue


@pytest.mark.parametrize("camera", ["above", "touching", "front", "wrist"])
def test_both_renderers_draw_the_same(worlds, camera):
    """Colours differ by less than 4 of 255 in the mean; 4% of pixels may by more than 24, and 1% show another thing: edges. Of
    what is the same thing, 99% of the depths agree to 5 mm.

    OpenGL lights the corners of squares, the ray tracer pixels.
    """
    one, other = (worlds[1][name][camera] for name in ("mujoco", "warp"))
    colors = np.abs(one.rgb.astype(int) - other.rgb)
    assert colors.mean() < 4
    assert (colors.max(-1) > 24).mean() < 0.04
    same = one.segmentation == other.segmentation
    assert same.mean() > 0.99
    assert np.percentile(np.abs(one.depth - other.depth)[same], 99) < 5e-3


STATES = 24


@pytest.mark.parametrize("name", ["nero_lift", "cobotta_lift", "piper_lift", "so100_lift", "so101_lift"])
def test_default_cameras_see_the_cube_and_the_hand(name):
    """Over random states the cube covers at least 10 pixels of the front picture in the mean, and 4 in 90% of states.

    The wrist's camera sees 4 pixels or more in two thirds of states at home, from where the hand comes nearer.
    """
    cfg = registry.env_cfg(name, "rgb")
    model, rng = scene.build(cfg.robot, cfg.scene, cfg.sim), np.random.default_rng(1)
    data, seen = mujoco.MjData(model), {"front": [], "wrist": []}
    joints = [model.joint(j).qposadr[0] for j in cfg.robot.joints]
    event = cfg.events["reset_object_position"].params
    hand = set(np.flatnonzero(model.geom_bodyid >= model.site_bodyid[model.site(cfg.robot.ee_site).id]))
    with mujoco.Renderer(model, 64, 64) as renderer:
        renderer.enable_segmentation_rendering()
        for _ in range(STATES):
            data.qpos[joints] = cfg.robot.home
            data.joint("cube").qpos[:2] = [rng.uniform(*event[axis]) for axis in "xy"]
            mujoco.mj_forward(model, data)
            for camera in seen:
                renderer.update_scene(data, MARK + camera)
                geoms = renderer.render()[..., 0]
                seen[camera].append((geoms == model.geom("cube").id).sum())
                assert hand & set(geoms.flatten()), (name, camera)
    front, wrist = np.array(seen["front"]), np.array(seen["wrist"])
    assert front.mean() >= 10 and (front >= 4).mean() >= 0.9, front
    assert (wrist >= 4).mean() >= 2 / 3, wrist
    assert (np.maximum(front, wrist) >= 4).all(), (front, wrist)


def test_cameras_of_bundled_policies_stand_where_they_stood():
    """Policies that come with the package saw pictures from these places."""
    found = {name: places.find(registry.robot(name)) for name in ("nero", "piper", "cobotta_pro_900", "so_arm101")}
    assert {name: cameras["wrist"].pos for name, cameras in found.items()} == {
        "nero": (0.15, 0.0, 0.065),
        "piper": (-0.12, 0.0, 0.065),
        "cobotta_pro_900": (-0.09, 0.0, 0.2),
        "so_arm101": (0.01, 0.15, -0.03),
    }
    assert found["nero"]["front"].pos == (0.9145, -0.254, 0.6084) and found["piper"]["front"].pos == (0.8571, -0.2642, 0.6253)
    assert found["nero"]["wrist"].quat == (0.3484, 0.6153, 0.6153, 0.3484)
    assert found["piper"]["wrist"].quat == (-0.3162, -0.6325, 0.6325, 0.3162)


@pytest.mark.parametrize("name", registry.ROBOTS)
def test_a_small_camera_fits_at_the_wrist(name):
    """Within 2.5 cm there is nothing, closed and open; the grasp point is 10 cm away, the table 6 cm lower than the camera."""
    robot = registry.robot(name)
    camera, (model, data) = places.find(robot)["wrist"], scene.at_home(robot, whole=True)
    hand = model.site(robot.ee_site)
    away = np.array(camera.pos) - hand.pos
    back = quats.matrix(hand.quat) @ quats.matrix(np.array(robot.down)).T[:, 2]  # the hand's axis, away from its fingers
    assert np.linalg.norm(away) >= 0.1 and away @ back > 0.0599
    ways = np.random.default_rng(0).normal(size=(300, 3))
    for fingers in (robot.gripper.open, robot.gripper.close):
        for joint, position in zip(robot.gripper.joints, fingers, strict=True):
            data.joint(joint).qpos[0] = position
        mujoco.mj_kinematics(model, data)
        link = data.body(camera.link)
        eye = link.xpos + link.xmat.reshape(3, 3) @ camera.pos
        hits = [mujoco.mj_ray(model, data, eye, way / np.linalg.norm(way), None, 1, -1, np.zeros(1, np.int32)) for way in ways]
        assert min(hit for hit in hits if hit >= 0) > 0.025


def test_a_hand_without_room_for_a_camera_is_refused(monkeypatch):
    monkeypatch.setattr(places, "_FREE", 1.0)  # [m]: the table is nearer
    places._on_hand.cache_clear()
    with pytest.raises(UserError, match="^nero leaves no room for a camera at its hand: set scene.cameras yourself$"):
        places.wrist(registry.robot("nero"))


@pytest.fixture(scope="module")
def pictured():
    """Two environments on MuJoCo's renderer, of episodes of three steps."""
    env = mjx_nero.make(
        "nero_lift", "rgb_fixed", impl="native", num_envs=2, **{"episode_length_s": 0.06, "scene.cameras.front.size": (16, 16)}
    )
    return env, jax.jit(jax.vmap(env.reset)), jax.jit(jax.vmap(env.step_and_reset))


def test_an_observation_is_the_picture_of_its_own_episode(pictured):
    env, reset, step = pictured
    state = reset(jax.random.split(jax.random.PRNGKey(0), 2))
    assert state.obs["pictures"]["front"].dtype == jnp.uint8 and state.obs["pictures"]["wrist"].shape == (2, 64, 64, 3)
    draw = jax.jit(jax.vmap(lambda s: env.view(s).cameras["front"].rgb))
    for _ in range(3):
        before, state = state.obs["pictures"]["front"], step(state, jnp.zeros((2, env.action_size)))
        np.testing.assert_array_equal(state.obs["pictures"]["front"], draw(state))
    assert state.done.all() and (before != state.obs["pictures"]["front"]).any()


def test_nobody_draws_what_nobody_reads(pictured, monkeypatch):
    env, reset, _ = pictured
    drawn = []
    monkeypatch.setattr(opengl.OpenGL, "_draw_rows", lambda self, rows, images: drawn.append(len(rows)))
    state = reset(jax.random.split(jax.random.PRNGKey(0), 2))
    assert drawn.pop() == 2 and not drawn
    jax.jit(jax.vmap(lambda s, a: env.step(s, a).reward))(state, jnp.zeros((2, env.action_size))).block_until_ready()
    assert not drawn


def test_without_cameras_nothing_changes():
    env = mjx_nero.make("nero_lift", impl="native")
    model, seeing = env.mj_model, mjx_nero.make("nero_lift", "rgb", impl="native")
    assert [model.camera(i).name for i in range(model.ncam)] == ["front", "side"]
    assert not jax.eval_shape(lambda key: env.view(env.reset(key)), jax.random.PRNGKey(0)).cameras
    assert "cameras" not in env.__dict__  # nothing was made
    assert mujoco.mj_sizeModel(seeing.physics_model) == mujoco.mj_sizeModel(env.physics_model)


@pytest.mark.parametrize(
    "fields, message",
    [
        ({"link": "hand"}, r"scene.cameras.front.link is 'hand', but the scene's links are: base_link, .*"),
        ({"size": (64, 4000)}, r"size must be at least 1 and at most 2048, got 4000"),
        ({"size": (0, 64)}, r"size must be at least 1"),
        ({"fovy": 180.0}, r"fovy must be at least 1"),
        ({"kinds": ("infrared",)}, r"a camera's kinds are one or more of rgb, depth, segmentation"),
        ({"quat": (0.0, 0.0, 0.0, 0.0)}, r"a camera's quat is an orientation"),
    ],
)
def test_bad_cameras_are_refused(fields, message):
    with pytest.raises(UserError, match=message):
        cfg = with_cameras({"front": CameraCfg(**fields)})
        scene.build(cfg.robot, cfg.scene, cfg.sim)


@pytest.mark.parametrize(
    "term, camera, message",
    [
        (images.rgb, "back", r"reads the camera 'back', but the scene's cameras \(scene.cameras\) are: front"),
        (images.depth, "front", r"reads depth of the camera 'front': add it to scene.cameras.front.kinds"),
    ],
)
def test_terms_ask_for_what_is_there(term, camera, message):
    cfg = with_cameras({"front": CameraCfg()})
    group = ObservationGroup({"seen": ObservationTerm(term, params={"camera": camera})}, apart=True)
    cfg = dataclasses.replace(cfg, observations={**cfg.observations, "pictures": group})
    with pytest.raises(UserError, match=message):
        _ = mjx_nero.ManipulationEnv(cfg, impl="native").observation_size


def test_a_machine_without_opengl_says_so(without_opengl):
    cfg = with_cameras({"front": CameraCfg()})
    with pytest.raises(UserError, match=r"no offscreen OpenGL here"):
        cameras.Cameras(scene.build(cfg.robot, cfg.scene, cfg.sim), cfg.scene.cameras, "mujoco")


def test_a_process_may_ask_again_for_pictures_that_it_cannot_draw():
    """GLFW's second failure ends a process, and a program that films many environments asks once for each."""
    code = """
import mujoco
from mjx_nero import UserError
from mjx_nero.sim.render import Renderer
for _ in range(3):
    try:
        Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"))
    except UserError as error:
        print(error)
"""
    env = {name: value for name, value in os.environ.items() if name != "DISPLAY"} | {"MUJOCO_GL": "glfw"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=env)
    assert done.returncode == 0 and done.stdout.count("no offscreen OpenGL here") == 3 and not done.stderr


@pytest.mark.parametrize("gl", ["egl", "osmesa"])
def test_a_program_that_closes_no_renderer_ends_in_silence(gl):
    code = """
import threading, mujoco
from mjx_nero.sim.render import Renderer
made = []
def make():
    made.append(Renderer(mujoco.MjModel.from_xml_string("<mujoco/>")))
thread = threading.Thread(target=make)
thread.start()
thread.join()
make()
"""
    env = {**os.environ, "MUJOCO_GL": gl, "PYOPENGL_PLATFORM": gl}
    done = subprocess.run([sys.executable, "-c", code], stderr=subprocess.PIPE, text=True, env=env)
    if "no offscreen OpenGL" in done.stderr:
        pytest.skip("no offscreen OpenGL")
    assert (done.returncode, done.stderr) == (0, "")


def test_the_guide_says_what_is_so():
    page = (pathlib.Path(__file__).resolve().parents[2] / "docs" / "guides" / "cameras.md").read_text()
    (code,) = re.findall(r"^```python\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    names = {}
    exec(code, names)
    assert names["env"].observation_size["pictures"] == {"side": (32, 32, 3)}
