"""Opens the view of the command ``view``: the session, its page and the door that guards it."""

import functools
import pathlib
import threading
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp

from mjx_nero import config, files
from mjx_nero.config import values
from mjx_nero.data import open_dataset
from mjx_nero.envs.env import ManipulationEnv
from mjx_nero.interop import need
from mjx_nero.learn import policy
from mjx_nero.runs.evaluation_cfg import controller_of
from mjx_nero.runs.folder import CONFIG
from mjx_nero.sim import team
from mjx_nero.tasks import registry
from mjx_nero.tools import cli
from mjx_nero.tools.view import agents
from mjx_nero.types import UserError

if TYPE_CHECKING:
    from mjx_nero.tools.view import leader as leaders

WATCH_S = 2.0  # time between two looks at a followed run


def serve(**kwargs: Any) -> None:
    """Serves the page until Ctrl-C.

    Args:
        kwargs: arguments of ``open_view``.
    """
    cli.setup_jax()
    view = open_view(**kwargs)
    print(f"{view.url}  (Ctrl-C ends it)", flush=True)
    try:
        view.wait()
    finally:
        view.close()


class View:
    """A page that is being served.

    Attributes:
        url: address to open, with its token.
        server: viser's server.
        session: the session that it shows.
        panel: its controls.
        hands: controls of the user's hand.
    """

    def __init__(self, page, door, orders, session, panel, hands, run: pathlib.Path | None, env_name: str):
        self._page, self._door, self._orders = page, door, orders
        self.session, self.panel, self.hands = session, panel, hands
        self.leader: leaders.Leader | None = None  # a leader arm that is being read
        self.url, self.server = door.url, page.server
        self._run, self._env_name = run, env_name
        self._seen: pathlib.Path | None = None
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self, shown) -> None:
        """Starts the session."""
        self._thread = threading.Thread(target=self.session.run, args=(shown,), daemon=True)
        self._thread.start()

    def wait(self) -> None:
        """Waits until the view is closed, and follows the run meanwhile; raises the error of a simulation that fails."""
        while self.session.failure is None and not self._ended.wait(WATCH_S):
            self.follow()
        if self.session.failure is not None:
            raise self.session.failure

    def follow(self) -> None:
        """Plays the newest checkpoint of the run, if it is new."""
        newest = agents.newest(self._run) if self._run else None
        if newest is None or newest == self._seen:
            return
        self._seen, env = newest, self.session.env
        trained = functools.partial(policy.load_for, env, self._env_name, newest, any_robot=True)
        self.panel.add(f"run {newest.stem}", lambda: agents.of_policy(trained()))
        self.session.reset()

    def close(self) -> None:
        """Ends the simulation and the servers."""
        self._ended.set()
        if self.leader:
            self.leader.close()
        self.session.stop()
        if self._thread:
            self._thread.join(timeout=5)
        self._door.close()
        self._orders.close()
        self._page.close()


def open_view(
    env_name: str | None = None,
    preset: str | None = None,
    robot: str | None = None,
    policies: Sequence[pathlib.Path] = (),
    agent: str | None = None,
    run: pathlib.Path | None = None,
    num_envs: int = 1,
    seed: int = 1,
    host: str = "127.0.0.1",
    port: int = 8080,
    overrides: Mapping[str, Any] | None = None,
    demos: pathlib.Path | None = None,
    episode: int | None = None,
    leader: "leaders.Readable | None" = None,
) -> View:
    """Serves the page and runs the environments.

    Args:
        agent: agent that acts first, by its name in ``agents.known``; None: a policy, or else a controller, or else the joint
            sliders.
        run: run folder to follow.
        host: address to listen on.
        port: first port to try.
        demos: data set into which the first environment can be recorded.
        episode: episode of that data set to replay first.
        leader: a connected arm that the user moves by hand.

    Raises:
        UserError: see ``command.main``.
    """
    need("viser")
    from mjx_nero.tools.view import hand, session, tape
    from mjx_nero.tools.view import leader as leaders

    described = _described(run) if run else _played(demos) if demos and episode is not None else {}
    env_name = env_name or described.get("env_name", "nero_lift")
    preset = preset or described.get("preset", "default")
    cfg = registry.env_cfg(env_name, preset, robot)
    env = ManipulationEnv(config.override(cfg.uncorrupted(), overrides or {}), impl="native", num_envs=num_envs)
    makers = agents.known(env, env_name, list(policies), preset)
    if leader and leaders.same_joints(env):
        makers[leaders.NAME] = lambda: leaders.agent(env)
    chosen = _chosen(agent and (controller_of(agent, env.cfg.controllers) or agent), list(makers), env_name)
    home = jnp.array(team.home(env.team)) if chosen == agents.SLIDERS else None
    sim = session.Session(env, num_envs, makers[chosen](), home, seed)
    if demos and episode is not None:
        sim.replay(tape.of_dataset(demos, episode, sim.frame))
    recording = hand.Recording(sim, demos, env_name, preset, fields=overrides) if demos else None
    if recording is not None and episode is None:  # an empty one is false
        recording.check()
    return _served(sim, makers, chosen, recording, leader, (host, port), run, env_name)


def _served(sim, makers, chosen: str, recording, leader, where: tuple[str, int], run: pathlib.Path | None, env_name: str) -> View:
    """Builds a session's page and starts both.

    Raises:
        UserError: see ``open_view``.
    """
    from mjx_nero.tools.view import door, hand, hand_panel, orders, panel, scene
    from mjx_nero.tools.view import leader as leaders

    page, guard = door.open_page(*where)
    work = orders.Orders()
    controls = panel.Panel(page.server, sim, makers, chosen, work)
    steered = hand.Hand(sim, lambda: hands.take_over())
    read, follow = None, None
    if leader:
        read, follow = leaders.attached(leader, sim, controls, steered, lambda name: hands.take_over(name))
    hands = hand_panel.HandPanel(page.server, controls, steered, recording, work, follow)
    page.gamepad = hands.gamepad
    picture = scene.Scene(page.server, sim, sim.env.mj_model, work, steered)
    view = View(page, guard, work, sim, controls, hands, run, env_name)
    view.leader = read

    def shown(frame) -> None:
        picture.show(frame)
        controls.show(frame)

    view.start(shown)
    return view


def _chosen(agent: str | None, names: Sequence[str], env_name: str) -> str:
    """Returns the name of the agent that acts first; the word "policy" may be left out."""
    found = next((name for name in (agent or names[0], f"policy {agent}") if name in names), None)
    if found is None:
        raise UserError(f"no agent {agent!r} can act in {env_name}: choose one of {', '.join(names)}")
    return found


def _played(demos: pathlib.Path) -> dict[str, Any]:
    """Returns the environment and the preset of a data set."""
    about = open_dataset(demos).schema.about
    return {"env_name": about["env"], "preset": about["preset"]}


def _described(run: pathlib.Path) -> dict[str, Any]:
    path = files.inside(run, CONFIG)
    if not path.exists():
        raise UserError(f"{run} is not a run folder: give the folder that train.py wrote (--out)")
    found = files.read_json(path)
    names = {key: found[key] for key in ("env_name", "preset") if key in found} if isinstance(found, dict) else None
    return values.read(Mapping[str, str], names, f"{path}:")
