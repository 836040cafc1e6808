"""The browser view: the session behind it, and the page itself in a real browser."""

import functools
import time

import imageio.v3 as imageio
import jax.numpy as jnp
import numpy as np
import pytest
import waiting
from flax import struct

import mjx_nero
from mjx_nero.learn import checkpoint, policy
from mjx_nero.learn.play.recorder import Recorder
from mjx_nero.tools.view import agents, opening
from mjx_nero.tools.view.orders import Orders
from mjx_nero.tools.view.scene import Scene
from mjx_nero.tools.view.session import Session, free_joints

wait = functools.partial(waiting.wait, seconds=180)  # a browser that draws in software is slow
STRONG = {"robot.gravity_compensation": True}  # the drives hold the arm up, so that it gets where it is sent


@pytest.fixture(scope="module")
def reach():
    return mjx_nero.make("nero_reach", impl="native", corruption=False, episode_length_s=2.0, **STRONG)


def session(env, name, size=1, **kwargs):
    return Session(env, size, agents.known(env, "nero_reach", [])[name](), **kwargs)


@pytest.fixture(scope="module")
def following(reach):
    return session(reach, "ik", size=2)


def test_who_can_act():
    def names(env_name):
        return list(agents.known(mjx_nero.make(env_name, impl="native"), env_name, []))

    assert names("nero_reach") == ["policy nero_reach", "ik", "rmpflow", "joint sliders", "your hand", "zero", "random"]
    assert names("nero_lift") == ["policy nero_lift", "pick_up", "joint sliders", "your hand", "zero", "random"]
    assert names("cobotta_follow_target") == ["rmpflow", "ik", "joint sliders", "your hand", "zero", "random"]


def test_the_arm_follows_a_goal_that_the_user_moves(following):
    following.reset()
    to = np.array([0.4, 0.1, 0.3])
    for _ in range(5):
        following.step()
    following.move_goal(0, to)
    np.testing.assert_allclose(following.frame.scenery.goal_pos_w[0], to, atol=1e-6)
    other = following.frame.scenery.goal_pos_w[1].copy()
    for _ in range(50):
        following.step()
    assert following.frame.distance < 0.01
    for _ in range(15):
        following.step()
    np.testing.assert_allclose(following.frame.scenery.goal_pos_w[0], to, atol=1e-6)  # still, in the next episode
    assert following.frame.step == 10
    assert np.abs(following.frame.scenery.goal_pos_w[1] - other).max() > 0.01  # the other environment's has been drawn anew
    following.reset()
    assert np.abs(following.frame.scenery.goal_pos_w[0] - to).max() > 0.01


def test_a_goal_on_a_path_goes_with_its_path():
    env = mjx_nero.make("nero_follow_target", impl="native")
    moving = Session(env, 1, agents.of_targets(env), jnp.array(env.cfg.robot.home))
    still = np.asarray(moving._state.info["carry"].command[0])
    moving.move_goal(0, moving.frame.scenery.goal_pos_w[0] + [0.02, -0.03, 0.04])
    np.testing.assert_allclose(moving._state.info["carry"].command[0], still + [0.02, -0.03, 0.04], atol=1e-6)


def test_sliders_drive_the_joints(reach):
    by_hand = session(reach, agents.SLIDERS, params=jnp.array(reach.cfg.robot.home))
    want = np.array(reach.cfg.robot.home) + [0.3, -0.2, 0.1, -0.2, 0.2, -0.1, 0.3, 0, 0]
    by_hand.params = jnp.array(want, jnp.float32)
    for _ in range(90):
        by_hand.step()
    np.testing.assert_allclose(by_hand.frame.qpos[0, :7], want[:7], atol=5e-3)


def test_a_cube_can_be_put_elsewhere():
    env = mjx_nero.make("nero_lift", impl="native", corruption=False)
    lift = Session(env, 2, agents.known(env, "nero_lift", [])["zero"]())
    assert free_joints(env.mj_model) == {"cube": "cube"}
    before = lift.frame.qpos.copy()
    lift.move_object(1, "cube", np.array([0.3, 0.1, 0.2]))
    np.testing.assert_allclose(lift.frame.qpos[1, -7:-4], [0.3, 0.1, 0.2], atol=1e-6)
    np.testing.assert_array_equal(lift.frame.qpos[0], before[0])
    for _ in range(5):  # a tenth of a second of free fall
        lift.step()
    assert lift.frame.qpos[1, -5] == pytest.approx(0.2 - 0.5 * 9.81 * 0.1**2, abs=0.01)


def test_curves_and_success(following):
    following.reset()
    for _ in range(121):  # two episodes of 60 steps
        following.step()
    assert len(following.successes) == 4  # of both environments
    curves = following.frame.curves
    assert set(curves["rewards"]) == set(following.env.cfg.rewards)
    assert curves["observations"]["joint_pos"].shape == (9,) and curves["actions"]["action"].shape == (7,)
    assert len(following.history) == 121


def test_every_step_is_handed_to_the_recorders(following):
    """Two environments with episodes of 60 steps: what is recorded ends where they do, though the view goes on."""
    keep = Recorder()
    following.reset()
    following.recorders.append(keep)
    for _ in range(70):
        following.step()
    following.recorders.remove(keep)
    found = keep.episodes()
    assert [len(episode.reward) for episode in found] == [60, 60]
    assert all(episode.truncated[-1] and episode.obs["state"].shape == (60, 47) for episode in found)
    assert all((np.abs(episode.qpos[-1] - following.frame.qpos[0]) > 1e-3).any() for episode in found)


def test_thirty_frames_a_second_leave_a_core_time(following):
    """A control step of 1/30 s with all that the page gets, in processor time: the machine may be busy with other work."""
    viser = pytest.importorskip("viser")
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    try:
        picture = Scene(server, following, following.env.mj_model, Orders())

        def frames(n):
            started = time.process_time()
            for _ in range(n):
                following.step()
                picture.show(following.frame)
            return (time.process_time() - started) / n

        frames(10)
        assert min(frames(15) for _ in range(4)) < 1 / 30
    finally:
        server.stop()


@struct.dataclass
class Trained:
    """Of PPO's state, what a policy acts by."""

    normalizer: object
    params: object


def test_checkpoints_of_a_training_play_too(tmp_path, reach):
    shipped = policy.load(policy.shipped("nero_reach"))
    run, state = tmp_path / "run", Trained(*shipped.params)
    assert agents.newest(run) is None
    checkpoint.save(run / "checkpoints" / "000000001000.safetensors", state, {**shipped.meta, "kind": "checkpoint"})
    path = agents.newest(run)
    loaded = policy.load_for(reach, "nero_reach", path)
    obs = {"state": jnp.linspace(-1, 1, 47)[None]}
    np.testing.assert_array_equal(loaded.act(obs), shipped.act(obs))
    with pytest.raises(mjx_nero.UserError, match="is a checkpoint of nero_reach"):
        policy.load_for(mjx_nero.make("nero_lift", impl="native"), "nero_lift", path)


@pytest.mark.slow
def test_a_training_writes_what_the_view_follows(call, tmp_path):
    sizes = ["--num-envs", 64, "--num-timesteps", 1536]  # test_wheel's, so that one of the two finds its programs compiled
    assert call("train", "--env", "nero_reach", *sizes, "--no-video", "--out", "run")[0] == 0
    followed = opening.open_view(run=tmp_path / "run", port=18100)
    try:
        followed.follow()
        assert followed.panel.agent.value.startswith("run ") and followed.session.env.cfg.robot.name == "nero"
    finally:
        followed.close()


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["--env", "nero_lfit"], "unknown env 'nero_lfit' (did you mean 'nero_lift'?)"),
        (
            ["--agent", "rmpflow"],
            "no agent 'rmpflow' can act in nero_lift: choose one of policy nero_lift, pick_up, joint sliders",
        ),
        (["--run", "."], ". is not a run folder: give the folder that train.py wrote"),
        (["--policy", "nowhere.safetensors"], "no such file: nowhere.safetensors"),
        (["--episode", "1"], "--episode selects an episode of a data set: pass --demos DIR, too"),
        (["--leader", "/dev/null"], "--leader needs --calibration: the leader's file written by lerobot-calibrate"),
        (["--demos", "nowhere", "--episode", "0"], "nowhere holds no demonstrations of mjx_nero"),
    ],
)
def test_mistakes_are_one_line(call, argv, message):
    status, out, err = call("mjx_nero", "view", *argv)
    assert (status, out) == (2, "") and message in err and err.count("\n") == 1


def on_screen(client, point):
    """Where the camera of a page shows a point of the world [pixels from the middle of the canvas]."""
    camera = client.camera
    forward = camera.look_at - camera.position
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, camera.up_direction)
    right /= np.linalg.norm(right)
    down, to = np.cross(forward, right), point - camera.position
    focal = camera.image_height / 2 / np.tan(camera.fov / 2)
    return focal * np.array([to @ right, to @ down]) / (to @ forward)


@pytest.mark.slow
def test_in_a_browser(browser):
    from selenium.webdriver.common.action_chains import ActionChains
    from selenium.webdriver.common.by import By

    # One long episode: a slow browser takes more than one of the usual length until it pauses.
    overrides = {"scene.view_distance": 1.4, "episode_length_s": 120.0, **STRONG}
    page = opening.open_view(env_name="nero_reach", agent="ik", port=18080, overrides=overrides)
    try:
        browser.get(page.url)
        canvas = wait(lambda: browser.find_elements(By.TAG_NAME, "canvas"))[0]
        wait(lambda: "Agent" in browser.find_element(By.TAG_NAME, "body").text)
        client = wait(lambda: list(page.server.get_clients().values()))[0]
        wait(lambda: page.session.frame.step > 0)

        def button(name):
            return browser.find_element(By.XPATH, f"//button[.//*[text()='{name}'] or text()='{name}']")

        button("Pause").click()
        wait(lambda: not page.session.running)
        wait(lambda: "Run" in browser.find_element(By.TAG_NAME, "body").text)
        time.sleep(0.5)
        before = page.session.frame.step
        button("Step").click()
        wait(lambda: page.session.frame.step == before + 1)

        def look():
            return imageio.imread(canvas.screenshot_as_png)[..., :3]

        picture = look()
        page.session.move_goal(0, np.array([0.4, 0.1, 0.27]))
        wait(lambda: (look() != picture).sum() > 300)
        picture = look()
        assert picture.std() > 20 and len(np.unique(picture.reshape(-1, 3), axis=0)) > 200

        x, y = on_screen(client, page.session.frame.scenery.goal_pos_w[0])
        mouse = (
            ActionChains(browser, duration=100).move_to_element_with_offset(canvas, int(x), int(y)).pause(0.5).click_and_hold()
        )
        for _ in range(4):
            mouse = mouse.move_by_offset(0, -8).pause(0.2)
        mouse.pause(0.5).release().perform()
        wait(lambda: page.session.frame.scenery.goal_pos_w[0, 2] > 0.27 + 0.03)
        time.sleep(2)  # its last messages
        moved = page.session.frame.scenery.goal_pos_w[0]
        assert moved[2] > 0.27 + 0.03 and abs(moved[1] - 0.1) < 0.03  # up, as the mouse
        arm = page.session.frame.qpos[0, :7].copy()
        assert page.session.frame.step == before + 1  # all else has stood still
        button("Run").click()
        wait(lambda: page.session.frame.step > before + 60 and page.session.frame.distance < 0.01)
        np.testing.assert_allclose(page.session.frame.scenery.goal_pos_w[0], moved, atol=1e-6)
        assert np.abs(page.session.frame.qpos[0, :7] - arm).max() > 0.02
        errors = [line["message"] for line in browser.get_log("browser") if line["level"] == "SEVERE"]
        # What Chromium says of viser's own listener for the mouse wheel; the page scrolls all the same.
        assert [e for e in errors if "preventDefault inside passive event listener" not in e] == []
    finally:
        page.close()
