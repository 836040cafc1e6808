"""Photographs and patterns: read, put on geoms that differ from world to world, and drawn alike by both renderers."""

import dataclasses

import imageio.v3 as imageio
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_nero.mdp import looks
from mjx_nero.mdp.randomization import Model
from mjx_nero.mdp.terms import Term
from mjx_nero.sim import cameras, scene
from mjx_nero.sim.cameras import textures
from mjx_nero.sim.cameras.cfg import CameraCfg
from mjx_nero.sim.cameras.look import Look
from mjx_nero.tasks import registry
from mjx_nero.types import Scenery, UserError

# Straight down on the table's middle, all of which and a little more it sees: 1.2 m of y over 64 pixels, x upwards.
DOWN = CameraCfg(pos=(0.3, 0.0, 3.0), quat=(0.7071068, 0.0, 0.0, -0.7071068), fovy=22.6)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A photograph whose quarters are red, green, blue and white, in the order of reading, and a grey one."""
    where = tmp_path_factory.mktemp("photographs")
    quarters = np.zeros((40, 60, 3), np.uint8)
    quarters[:20, :30, 0] = quarters[:20, 30:, 1] = quarters[20:, :30, 2] = 255
    quarters[20:, 30:] = 255
    imageio.imwrite(where / "b.png", quarters)
    imageio.imwrite(where / "a.JPG", np.full((600, 900, 3), 90, np.uint8), extension=".jpg")
    (where / "notes.txt").write_text("not a picture")
    (where / ".hidden.png").write_text("not looked at")
    return where


@pytest.fixture(scope="module")
def built(folder):
    """A scene with both, and the names of its materials."""
    cfg = registry.env_cfg("nero_reach")
    seen = dataclasses.replace(cfg.scene, cameras={"down": DOWN}, photographs=str(folder), patterns=3, goal="none")
    model = scene.build(cfg.robot, seen, cfg.sim)
    return cfg, seen, model, [model.mat(i).name for i in range(model.nmat)]


def test_photographs_are_read_in_order_and_made_smaller(folder):
    grey, quarters = textures.photographs(folder)
    assert grey.shape == (171, 256, 3) and np.abs(grey.astype(int) - 90).max() <= 2  # JPEG's
    assert quarters.shape == (40, 60, 3) and quarters[5, 5].tolist() == [255, 0, 0] and quarters[35, 5].tolist() == [0, 0, 255]


def test_patterns_are_grey_and_repeat_without_a_seam():
    for i in range(6):
        tile = textures.pattern(i)
        assert tile.shape == (64, 64, 3) and (tile == tile[..., :1]).all() and tile.std() > 5
        np.testing.assert_array_equal(tile, textures.pattern(i))
    cloud = textures.pattern(2)[..., 0].astype(int)
    assert np.abs(cloud[0] - cloud[-1]).max() <= np.abs(np.diff(cloud, axis=0)).max() + 1


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "is not a folder: give one with pictures"),
        ({}, "has 0 pictures .PNG or JPEG., but a scene takes 1 to 200"),
        ({"a.png": b"\x89PNG\r\n\x1a\n nonsense"}, "cannot read .*a.png: "),
        ({"a.jpg": b""}, "cannot read .*a.jpg: cannot identify image"),
        ({"a.png": b"GIF89a"}, "cannot read .*a.png: cannot identify image"),
    ],
)
def test_what_cannot_be_read_is_one_line(content, message, tmp_path):
    where = tmp_path / "pictures"
    if content is not None:
        where.mkdir()
        for name, data in content.items():
            (where / name).write_bytes(data)
    with pytest.raises(UserError, match=message) as error:
        list(textures.photographs(where))
    assert "\n" not in str(error.value)


def test_both_renderers_show_each_worlds_own(built):
    """The table in three worlds: as it is, the quarters twice along each edge, a pattern. Means over a quarter's middle."""
    cfg, seen, model, names = built
    table, robot = model.geom("table_top").id, model.geom_bodyid > 0
    matid = np.tile(model.geom_matid, (3, 1)).astype(np.int32)
    matid[1:, table] = names.index("photograph_1"), names.index("pattern_1")
    rgba = np.tile(model.geom_rgba, (3, 1, 1)).astype(np.float32)
    rgba[1, table] = 1.0
    rgba[:, robot, 3] = 0.0  # out of the way
    drawn = {}
    for renderer in ("mujoco", "warp"):
        eyes = cameras.Cameras(model, seen.cameras, renderer, fields=("geom_matid", "geom_rgba"))
        qpos = jnp.tile(jnp.asarray(model.qpos0, jnp.float32), (3, 1)).at[:, 1].set(1.5)
        look = {"geom_matid": jnp.asarray(matid), "geom_rgba": jnp.asarray(rgba)}
        unseen = Scenery(jnp.zeros((3, 3)), jnp.ones((3, 4)), look=look)
        drawn[renderer] = jax.device_get(jax.jit(jax.vmap(eyes))(qpos, unseen))["down"].rgb
    # The photograph's top left corner is at the picture's bottom left: +x, upwards here, goes to its right.
    at = {"red": (0, 1), "green": (0, 0), "blue": (1, 1), "white": (1, 0)}
    lit = {"red": [1, 0, 0], "green": [0, 1, 0], "blue": [0, 0, 1], "white": [1, 1, 1]}
    for rgb in drawn.values():
        plain, quarters, patterned = rgb.astype(float)
        assert patterned.std() > plain.std() + 5
        for name, (column, row) in at.items():  # a photograph has 32 x 27 pixels, the first ones 5 pixels below the edge
            patch = quarters[5 + 13 * row + 3 :, 16 * column + 4 :][:8, :8].mean(axis=(0, 1))
            assert (patch > 120).tolist() == [bool(x) for x in lit[name]], name
    off = np.abs(drawn["mujoco"].astype(int) - drawn["warp"])
    assert off.mean() < 6 and (off.max(-1) > 24).mean() < 0.15  # one samples between pixels in another way than the other


def test_looks_choose_among_what_there_is(built):
    _, _, model, names = built
    terms = {
        "photos": Term(looks.photographs, params={"geoms": ("table_top",), "share": 0.5, "shade": (0.5, 0.8)}),
        "robot": Term(looks.patterns, params={"share": 0.25}),
    }
    look = Look(model, terms)
    assert look.names == ("geom_matid", "geom_rgba")
    drawn = jax.jit(jax.vmap(look))(jax.random.split(jax.random.PRNGKey(0), 2000))
    table, robot = model.geom("table_top").id, np.flatnonzero(model.geom_matid >= 0)
    shown = np.array(drawn["geom_matid"][:, table])
    photos = [names.index(f"photograph_{i}") for i in range(2)]
    assert drawn["geom_matid"].dtype == jnp.int32
    for i in photos:
        assert (shown == i).mean() == pytest.approx(0.25, abs=0.03)
    assert (shown == -1).mean() == pytest.approx(0.5, abs=0.04)
    rgba = np.array(drawn["geom_rgba"][:, table])
    assert (rgba[shown == -1] == model.geom_rgba[table].astype(np.float32)).all()
    assert 0.5 <= rgba[shown >= 0, :3].min() < 0.51 and 0.79 < rgba[shown >= 0, :3].max() <= 0.8
    own = np.array(drawn["geom_matid"][:, robot])
    patterned = (own != model.geom_matid[robot]).any(axis=1)
    assert patterned.mean() == pytest.approx(0.25, abs=0.03)
    assert (own[patterned] == own[patterned][:, :1]).all() and all(names[i].startswith("pattern_") for i in own[patterned, 0])
    np.testing.assert_allclose(drawn["geom_rgba"][patterned][0][robot], model.mat_rgba[model.geom_matid[robot]], atol=1e-6)
    half = look(jax.random.PRNGKey(3), jnp.float32(0.5))
    assert half["geom_matid"].dtype == jnp.int32  # numbers of materials are not mixed


def test_without_pictures_nothing_is_drawn():
    model = Model({"geom_rgba": jnp.ones((1, 4))}, {"geom": {"table_top": 0}, "material": {"steel": 0}, "robot": {}})
    assert looks.photographs(jax.random.PRNGKey(0), model, geoms=("table_top",)) == {}
    assert looks.patterns(jax.random.PRNGKey(0), model, geoms=("table_top",), share=1.0) == {}
