"""Observations of a real arm against the environment's terms; where objects are, as others say it."""

import json
import socket

import jax
import numpy as np
import pytest

import mjx_nero
from mjx_nero.deploy import places, setup
from mjx_nero.deploy.arm import Feedback
from mjx_nero.deploy.observe import TERMS, Observer
from mjx_nero.errors import UserError
from mjx_nero.interop import onnx as export
from mjx_nero.learn import policy


def told_by(env, env_name):
    """Metadata as a file would have them."""
    return json.loads(json.dumps(export.metadata(policy.load(policy.shipped(env_name)), env)))


@pytest.mark.parametrize("env_name", ["so101_lift", "nero_reach", "piper_reach", "cobotta_lift", "nero_push"])
def test_observations_are_the_environments(env_name):
    """Steps of a simulated episode, seen by the environment and by the runtime."""
    env = mjx_nero.make(env_name, impl="native", corruption=False)
    told = told_by(env, env_name)
    known = places.Known()
    observer = Observer(told, setup.body_of(told), None, known)
    reset, step, view = (jax.jit(f) for f in (env.reset, env.step, env.view))
    named = jax.jit(lambda state: env.named_observations(state)["state"])
    state, rng = reset(jax.random.PRNGKey(3)), np.random.default_rng(0)
    action = np.zeros(env.action_size)
    for _ in range(6):
        seen, terms = view(state), named(state)
        observer.goal, observer.goal_quat = np.asarray(seen.command, float), np.asarray(seen.goal_quat_w, float)
        for name, item in seen.objects.items():
            at = np.asarray(item.pos_w - seen.root_pos_w, float).tolist()
            quat = np.asarray(item.quat_w, float)
            known.say(json.dumps({"object": name, "position": at, "quaternion": (quat / np.linalg.norm(quat)).tolist()}), 0.0)
        feedback = Feedback(0.0, np.asarray(seen.joint_pos, float), np.asarray(seen.joint_vel, float))
        ours = observer(feedback, np.asarray(seen.ctrl, float), action, 0.0)
        assert set(ours) == set(terms)
        for name, value in terms.items():
            np.testing.assert_allclose(ours[name], value, atol=3e-6, err_msg=name)
        action = np.asarray(rng.uniform(-1, 1, env.action_size), np.float32)
        state = step(state, action)


def test_the_middle_of_the_region_is_the_goal():
    told = told_by(mjx_nero.make("piper_reach", impl="native"), "piper_reach")
    observer = Observer(told, setup.body_of(told), None, places.Known())
    np.testing.assert_allclose(observer.goal, [0.35, 0.125, 0.3])
    np.testing.assert_allclose(observer.goal_quat, [np.sqrt(0.5), 0, np.sqrt(0.5), 0], atol=1e-9)  # pitched by a right angle
    turned = Observer(told, setup.body_of(told), [0.3, 0, 0.2, 0, 1, 0, 0], places.Known())
    np.testing.assert_allclose(turned.goal_quat, [0, 1, 0, 0])
    for wrong in ([1.0, 2.0], [0, 0, 0, 1, 1, 1, 1]):
        with pytest.raises(UserError, match="--goal takes"):
            Observer(told, setup.body_of(told), wrong, places.Known())


def test_what_an_arm_cannot_give_is_refused():
    told = told_by(mjx_nero.make("nero_push", impl="native"), "nero_push")
    told["observations"][0]["term"] = "object_velocity"
    with pytest.raises(UserError, match="observes object_velocity, not available on an arm: train with joint_pos, "):
        Observer(told, setup.body_of(told), None, places.Known())
    del told["observations"][0]["term"]
    with pytest.raises(UserError, match="export the policy again"):
        Observer(told, setup.body_of(told), None, places.Known())


def test_every_shipped_policy_of_one_object_can_be_observed():
    for env_name in ("nero_lift", "nero_push", "cobotta_lift", "so100_lift", "piper_lift", "so101_reach"):
        env = mjx_nero.make(env_name, impl="native")
        for term in env.cfg.observations["state"].terms.values():
            assert term.name in TERMS, (env_name, term.name)


@pytest.mark.parametrize(
    "text",
    [
        b"",
        b"{",
        b"[]]",
        b"nul",
        b'{"position": [1, 2]}',
        b'{"position": [1, 2, NaN]}',
        b'{"position": [1, 2, 1e999]}',
        b'{"position": [1, 2, true]}',
        b'{"position": [1, 2, "3"]}',
        b'{"position": [1, 2, 30]}',
        b'{"position": [0, 0, 0], "quaternion": [0, 0, 0, 0]}',
        b'{"position": [0, 0, 0], "object": 3}',
        b'"' + b"x" * 5000 + b'"',
        b"[" * 4000,
        bytes(range(256)),
    ],
)
def test_messages_that_are_none_are_refused(text):
    known = places.Known()
    known.say(b'{"position": [0.1, 0.2, 0.3]}', 0.0)
    known.say(text, 1.0)
    assert known.refused == 1
    np.testing.assert_allclose(known.find("cube", 1.0).position, [0.1, 0.2, 0.3])


def test_a_place_grows_old():
    known = places.Known(fresh=0.5)
    with pytest.raises(places.Lost, match="nobody has said where the cube is"):
        known.find("cube", 0.0)
    known.say(b'{"object": "cube", "position": [0.1, 0.2, 0.3]}', 10.0)
    known.find("cube", 10.5)
    with pytest.raises(places.Lost, match=r"the cube was last seen 0\.6 s ago"):
        known.find("cube", 10.6)
    with pytest.raises(places.Lost):
        known.find("ball", 10.0)


def test_a_file_is_read_again_when_it_changes(tmp_path):
    path = tmp_path / "cube.json"
    path.write_text('[{"object": "cube", "position": [0.1, 0, 0]}, {"object": "ball", "position": [0.2, 0, 0]}]')
    source = places.of(str(path))
    assert source.find("ball", 0.0).position[0] == 0.2
    path.write_text('{"object": "ball", "position": [0.25, 0, 0]}')
    assert source.find("ball", 0.0).position[0] == 0.25
    path.write_text("half a li")
    assert source.find("ball", 0.0).position[0] == 0.25
    with pytest.raises(UserError, match="does not hold the position of an object: not JSON"):
        places.of(str(path))
    with pytest.raises(UserError, match="there is no file"):
        places.of(str(tmp_path / "none.json"))


def test_datagrams_and_lines():
    udp = places.of("udp://127.0.0.1:0")
    send = places.sender("127.0.0.1", udp.port)
    for x in (0.1, 0.2):
        send("cube", np.array([x, 0, 0]), np.array([1.0, 0, 0, 0]))
    assert udp.find("cube", 0.0).position[0] == 0.2
    server = socket.create_server(("127.0.0.1", 0))
    tcp = places.of(f"tcp://127.0.0.1:{server.getsockname()[1]}")
    other, _ = server.accept()
    other.sendall(b'{"position": [0.3, 0, 0]}\n{"position": [0.4, 0')
    assert tcp.find("cube", 0.0).position[0] == 0.3
    other.sendall(b", 0]}\n" + b"rubbish\n")
    assert tcp.find("cube", 0.0).position[0] == 0.4 and tcp.refused == 1
    other.sendall(b"x" * 100_000)
    tcp.find("cube", 0.0)
    assert len(tcp._rest) <= places.LONGEST
    for source in (udp, tcp, other, server):
        source.close()


WRONG = ["udp://nowhere", "http://127.0.0.1:1", "udp://127.0.0.1:99999", "tcp://127.0.0.1:1", "1,2", "1,2,nan"]


@pytest.mark.parametrize("text", WRONG)
def test_wrong_sources_are_one_line(text):
    with pytest.raises(UserError):
        places.of(text)


def test_a_constant():
    np.testing.assert_allclose(places.of("0.3,-0.1,0.015").find("cube", 1e6).position, [0.3, -0.1, 0.015])
    np.testing.assert_allclose(places.of("0.3,-0.1,0.015,0,0,0,1").find("cube", 1e6).quaternion, [0, 0, 0, 1])
