"""Draws the pictures that no command draws: python docs/make_pictures.py [NAME ...]

A name draws one of them, no name all:
    lift         docs/lift.webp: one Nero lifts with its bundled policy
    thousand     docs/thousand.webp: a thousand of them in one batch
    gallery      docs/gallery/: an episode of every environment; gallery/nero_push draws one film
    seeing       docs/gallery/: episodes of the policies that see
    objects.png  the package's objects
    failures     docs/failures/: three failures of each task that falls short
"""

import dataclasses
import pathlib
import sys

import mjx_nero  # first: it chooses MuJoCo's OpenGL

# isort: split
import mujoco
import numpy as np
from PIL import Image

from mjx_nero.learn import policy
from mjx_nero.learn.play import rollout
from mjx_nero.runs import evaluation, videos
from mjx_nero.sim import render, solids
from mjx_nero.tasks import registry
from mjx_nero.tools import cli, results
from mjx_nero.tools.inspection import things

HERE = pathlib.Path(__file__).parent
LARGEST = 80_000  # bytes of a film of the gallery
STEPS = 150  # of an episode are shown: the cube is up by then
PICTURES = {  # name -> robots, width and height, steps between frames, quality of the WebP
    "lift": (1, (640, 400), 4, 60),
    "thousand": (1000, (640, 360), 5, 45),
}

# Environments with bundled policies of the preset rgb.
SEEING = ("nero_lift", "cobotta_lift", "piper_lift", "so101_lift", "cobotta_place", "cobotta_stack", "nero_place", "nero_stack")
FALL_SHORT = ("nero_clutter", "cobotta_place")  # a seed or more learnt too late: see docs/lab/results.md


def play(env: mjx_nero.ManipulationEnv) -> tuple[np.ndarray, np.ndarray]:
    """Returns qpos [steps, num_envs, nq] and scenery [steps, num_envs, ...] of the bundled policy's episodes."""
    shipped = policy.load_for(env, "nero_lift", None)
    run = rollout.runner(env, lambda params, obs, *_: shipped.act(obs), env.num_envs, record=env.num_envs)
    found = run(None, 1)
    print(f"{env.num_envs} episodes: success {found.summary()['success_rate']:.1%}")
    return np.asarray(found.qpos), found.scenery


def write(path: pathlib.Path, frames: list[Image.Image], seconds: float, quality: int) -> None:
    """Writes an animated WebP."""
    frames[0].save(
        path, save_all=True, append_images=frames[1:], duration=round(1e3 * seconds), loop=0, quality=quality, method=4
    )
    print(f"{path}: {len(frames)} frames, {path.stat().st_size / 1e6:.2f} MB")


def amid(model: mujoco.MjModel) -> mujoco.MjvCamera:
    """Returns a camera low before the first row of a thousand robots: near ones show their work, far ones their number."""
    model.vis.map.zfar = model.vis.map.fogend = 100.0  # of the scene's extent: the last row is 50 m away
    model.vis.quality.numslices, model.vis.quality.numstacks = 12, 6  # of round shapes: robots of a few pixels need no more
    camera = mujoco.MjvCamera()
    camera.lookat[:] = (16.0, 0.0, 0.2)
    camera.distance, camera.azimuth, camera.elevation = 10.0, 165.0, -20.0
    return camera


def gallery(folder: pathlib.Path) -> None:
    """Films every environment that has a bundled policy or is only for controllers."""
    learnt = set(results.learnable())
    for name in filter(registry.robot_of, mjx_nero.list_envs()):
        if name not in learnt or policy.shipped(name).exists():
            episode(folder / name)


def episode(path: pathlib.Path) -> None:
    """Films the first successful episode of an environment, played by its bundled policy or its controller."""
    preset, count = ("rgb", 4) if path.stem.endswith("_rgb") else ("default", 8)
    name = path.stem.removesuffix("_rgb")
    played = evaluation.play(evaluation.EvalCfg(name, preset, episodes=count, record=count, backend="mujoco"))
    film(path.with_suffix(".webp"), played, np.argmax(played.episodes.success, keepdims=True))


def seeing(folder: pathlib.Path) -> None:
    """Films the policies that act on pictures, with these in the corner."""
    for name in SEEING:
        episode(folder.with_name("gallery") / f"{name}_rgb")


def objects_sheet(path: pathlib.Path) -> None:
    """Draws the package's objects at rest, and behind each its convex parts."""
    each = [things.picture(things.of(name), 426, 240) for name in solids.names()]
    sheet = np.concatenate([np.concatenate(each[i : i + 3], axis=1) for i in range(0, len(each), 3)])
    Image.fromarray(sheet).save(path, optimize=True)


def failures(folder: pathlib.Path) -> None:
    """Films the first three failures in 200 episodes, one after another, as ``eval.py --failures`` does."""
    for name in FALL_SHORT:
        played = evaluation.play(evaluation.EvalCfg(name, episodes=200, record=200, backend="mujoco"))
        film(folder / f"{name}.webp", played, np.flatnonzero(~played.episodes.success)[:3])


def film(path: pathlib.Path, played: evaluation.Played, which: np.ndarray) -> None:
    """Films the recorded episodes ``which``, 40 frames each, in the best quality within ``LARGEST``."""
    path.parent.mkdir(exist_ok=True)
    shown, frames = played.episodes.recorded(which), []
    every = max(1, len(shown.qpos) // 40)
    with render.Renderer(played.env.mj_model, 640, 480, samples=0, shadows=1024) as renderer:
        for k in range(len(which)):
            for t in range(0, len(shown.qpos), every):
                frame = Image.fromarray(renderer.render(shown.qpos[t, k], shown.scenery[t, k])).resize(
                    (320, 240), Image.Resampling.BOX
                )
                frames.append(Image.fromarray(videos.inset(np.array(frame), [each[t, k] for each in shown.pictures])))
    for quality in (35, 20, 10):
        write(path, frames, every * played.env.dt, quality)
        if path.stat().st_size < LARGEST:
            break


def main() -> None:
    """Draws all pictures, or those named."""
    cli.setup_jax()
    folders = {"gallery": gallery, "seeing": seeing, "failures": failures, "objects.png": objects_sheet}
    for name in sys.argv[1:] or (*folders, *PICTURES):
        if name in folders or name.startswith("gallery/"):
            folders.get(name, episode)(HERE / name)
            continue
        robots, (width, height), every, quality = PICTURES[name]
        cfg = dataclasses.replace(mjx_nero.env_cfg("nero_lift"), corruption=False)
        env = mjx_nero.ManipulationEnv(cfg, impl="native", num_envs=robots)
        qpos, scenery = play(env)
        how = {} if robots == 1 else {"camera": amid(env.mj_model), "samples": 0, "shadows": 0}
        with render.Renderer(env.mj_model, 2 * width, 2 * height, envs=robots, **how) as renderer:  # twice: edges become smooth
            shot = renderer.render_all if robots > 1 else lambda q, g: renderer.render(q[0], g[0])
            drawn = (Image.fromarray(shot(qpos[t], scenery[t])) for t in range(0, STEPS, every))
            frames = [frame.resize((width, height), Image.Resampling.BOX) for frame in drawn]
        write(HERE / f"{name}.webp", frames, every * env.dt, quality)


if __name__ == "__main__":
    main()
