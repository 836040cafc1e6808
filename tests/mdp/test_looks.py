"""What an episode looks like: the terms' ranges, and a camera as real ones are."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from views import blank

from mjx_nero.mdp import images, looks
from mjx_nero.mdp.randomization import Model
from mjx_nero.mdp.terms import Term
from mjx_nero.sim import scene
from mjx_nero.sim.cameras.look import Look
from mjx_nero.tasks import registry
from mjx_nero.types import Picture, UserError

MODEL = Model(
    {
        "cam_pos": jnp.array([[0.0, 0.0, 0.0], [1.0, 2.0, 3.0]]),
        "cam_quat": jnp.tile(jnp.array([1.0, 0.0, 0.0, 0.0]), (2, 1)),
        "cam_fovy": jnp.array([40.0, 60.0]),
        "light_dir": jnp.array([[0.0, 0.0, -1.0], [0.0, 0.6, -0.8]]),
        "light_diffuse": jnp.array([[0.5, 0.5, 0.5], [0.2, 0.2, 0.2]]),
        "geom_rgba": jnp.array([[0.5, 0.5, 0.5, 1.0], [1.0, 0.0, 0.0, 0.3]]),
    },
    {"camera": {"people": 0, "front": 1}, "geom": {"table": 0, "cube": 1}},
)


def drawn(term, **params):
    """A thousand draws: {field: (rows, values [1000, rows, ...])}."""
    rows = {field: row for field, (row, _) in term(jax.random.PRNGKey(0), MODEL, **params).items()}
    keys = jax.random.split(jax.random.PRNGKey(1), 1000)
    values = jax.jit(jax.vmap(lambda key: {f: v for f, (_, v) in term(key, MODEL, **params).items()}))(keys)
    return {field: (rows[field], np.asarray(values[field])) for field in rows}


def test_cameras_stand_and_look_a_little_elsewhere():
    found = drawn(looks.camera_pose, cameras=("front",), offset=0.02, turn=0.1)
    rows, pos = found["cam_pos"]
    assert list(rows) == [1]
    away = pos[:, 0] - [1.0, 2.0, 3.0]
    assert 0.019 < np.abs(away).max() < 0.0201 and np.abs(away.mean(0)).max() < 0.002
    angle = 2 * np.arccos(np.clip(found["cam_quat"][1][:, 0, 0], -1, 1))
    assert 0.1 < angle.max() < 0.1 * 3**0.5 + 1e-3  # about three axes
    fovy = drawn(looks.camera_fovy, cameras=("front",), scale=(0.9, 1.1))["cam_fovy"][1]
    assert 54 <= fovy.min() < 54.2 and 65.8 < fovy.max() <= 66


def test_lights_are_brighter_darker_and_sometimes_out():
    found = drawn(looks.lights, turn=0.2, brightness=(0.5, 2.0), tint=0.1, dark=0.25)
    out = (found["light_diffuse"][1] == 0).all(-1)
    assert out.mean() == pytest.approx(0.25, abs=0.03)
    lit = found["light_diffuse"][1][:, 0][~out[:, 0]]
    assert 0.25 * 0.9 <= lit.min() and lit.max() <= 1.0 * 1.1 and lit.max() > 0.9
    np.testing.assert_allclose(np.linalg.norm(found["light_dir"][1], axis=-1), 1, atol=1e-5)


def test_colors_stay_colors():
    rows, rgba = drawn(looks.colors, geoms=("cube",), change=0.2, shade=(0.5, 1.0))["geom_rgba"]
    assert list(rows) == [1] and rgba.shape == (1000, 1, 4)
    assert (rgba[..., 3] == np.float32(0.3)).all() and rgba.min() >= 0 and rgba.max() <= 1
    assert rgba[..., 0].min() >= 0.8 * 0.5 and rgba[..., 1].max() <= 0.2


def test_a_look_names_what_is_there():
    cfg = registry.env_cfg("nero_lift", "rgb")
    model = scene.build(cfg.robot, cfg.scene, cfg.sim)
    fields = Look(model, cfg.look)(jax.random.PRNGKey(0))
    assert fields["geom_rgba"].shape == (model.ngeom, 4) and set(fields) == set(Look(model, cfg.look).names)
    same = np.isclose(fields["geom_rgba"], model.geom_rgba).all(1)
    assert not same[[model.geom(name).id for name in ("table_top", "cube", "backdrop", "distractor_0")]].any()
    assert same[model.geom("goal").id]
    with pytest.raises(UserError, match="the model has no camera 'back': choose from front, wrist"):
        Look(model, {"pose": Term(looks.camera_fovy, params={"cameras": ("back",), "scale": (1.0, 1.1)})})
    with pytest.raises(UserError, match="look.mass draws body_mass: only cam_pos"):
        Look(model, {"mass": lambda key, model: {"body_mass": (np.array([1]), jnp.ones(1))}})


def view(value):
    """A view with a picture that is all of one value."""
    rgb = jnp.full((4, 4, 3), value, jnp.uint8)
    return blank(cameras={"front": Picture(rgb=rgb, depth=jnp.full((4, 4), value / 100))})


def seen(lens, values):
    """What the lens gives of pictures that are all of one value, one after another."""
    memory, out = lens.init(jax.random.PRNGKey(3), view(values[0])), []
    for value in values:
        memory, through = lens.step(memory, view(value))
        out.append(through.cameras["front"])
    return out


def test_a_lens_without_faults_changes_nothing():
    (found,) = seen(images.Lens(camera="front"), [100])
    assert found.rgb.dtype == jnp.uint8 and (found.rgb == 100).all() and (found.depth == 1.0).all()


def test_a_lens_is_late_and_takes_pictures_now_and_then():
    late = seen(images.Lens(camera="front", delay=(2, 2)), [10, 20, 30, 40])
    assert [int(each.rgb[0, 0, 0]) for each in late] == [10, 10, 10, 20]
    assert [round(float(each.depth[0, 0]), 2) for each in late] == [0.1, 0.1, 0.1, 0.2]
    every = seen(images.Lens(camera="front", every=3), [10, 20, 30, 40, 50])
    assert [int(each.rgb[0, 0, 0]) for each in every] == [10, 10, 10, 40, 40]


def test_a_lens_has_an_exposure_and_noise():
    first, second = seen(images.Lens(camera="front", exposure=(0.5, 0.5)), [100, 200])
    assert (first.rgb == 50).all() and (second.rgb == 100).all()
    noisy = seen(images.Lens(camera="front", noise=5.0, depth_noise=0.01, holes=0.3), [100, 100])
    colors = np.stack([each.rgb for each in noisy]).astype(float)
    assert 2 < colors.std() < 9 and (noisy[0].rgb != noisy[1].rgb).any()
    holes = np.mean([each.depth == 0 for each in noisy])
    assert 0.1 < holes < 0.6
    (coarse,) = seen(images.Lens(camera="front", depth_step=0.03), [100])
    np.testing.assert_allclose(coarse.depth, 0.99, atol=1e-6)
