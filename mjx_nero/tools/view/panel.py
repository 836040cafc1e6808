"""The controls beside the picture: run and step, agent, joints, curves."""

import contextlib
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_nero.sim import team
from mjx_nero.tools.view.agents import SLIDERS, Make
from mjx_nero.tools.view.orders import Orders
from mjx_nero.tools.view.session import CURVE, Frame, Session
from mjx_nero.types import UserError

COLORS = ("#1f77b4", "#d62728", "#2ca02c", "#ff7f0e", "#9467bd", "#8c564b", "#e377c2", "#7f7f7f", "#bcbd22", "#17becf")
CURVES_HZ = 5.0


class Panel:
    """Buttons, sliders and curves of a session.

    Args:
        server: a ``viser.ViserServer``.
        makers: agents to choose from, see ``agents.known``.
        chosen: the agent that acts first.
        orders: thread for everything that takes time.
    """

    def __init__(self, server, session: Session, makers: Mapping[str, Make], chosen: str, orders: Orders):
        self._session, self._makers, self._gui = session, dict(makers), server.gui
        self._orders, self._drawn, self._drawing = orders, 0.0, threading.Lock()
        self.parameters: dict[str, Callable[[], Any]] = {
            SLIDERS: self._slid_to
        }  # first parameters of agents that the user steers
        server.gui.configure_theme(show_logo=False, show_share_button=False)
        server.gui.main_panel.dock_right()
        self._status = server.gui.add_markdown("")
        self._run = server.gui.add_button("Pause")
        self._run.on_click(lambda _: self._pause())
        server.gui.add_button("Step").on_click(lambda _: session.single_step())
        server.gui.add_button("Reset").on_click(lambda _: orders.give("reset", session.reset))
        speed = server.gui.add_slider("Speed", min=0.1, max=4.0, step=0.1, initial_value=1.0)
        speed.on_update(lambda _: setattr(session, "speed", speed.value))
        self.agent = server.gui.add_dropdown("Agent", tuple(self._makers), initial_value=chosen)
        self.agent.on_update(lambda _: orders.give("play", lambda: self.play(self.agent.value)))
        self._message = server.gui.add_markdown("")
        self._joints = server.gui.add_folder("Joint targets", expand_by_default=chosen == SLIDERS)
        with self._joints:
            self._sliders = self._add_sliders()
        with server.gui.add_folder("Curves"):
            groups = {name: list(terms) for name, terms in session.frame.curves.items()}
            lines = [f"{group}: {term}" for group, terms in groups.items() for term in ("all", *terms)[group != "rewards" :]]
            self._what = server.gui.add_dropdown("Curve", tuple(lines), initial_value="rewards: all")
            self._what.on_update(lambda _: orders.give("curves", self._draw_curves))
            self._plot = None
            self._draw_curves()
        self._tell(session.frame)

    def show(self, frame: Frame) -> None:
        """Updates text and curves, a few times per second."""
        if time.perf_counter() - self._drawn >= 1 / CURVES_HZ:
            self._drawn = time.perf_counter()
            self._tell(frame)
            self._draw_curves()

    def add(self, name: str, make: Make) -> None:
        """Adds an agent and lets it act."""
        self._makers[name] = make
        self.agent.options = tuple(self._makers)
        self.agent.value = name

    def play(self, name: str) -> None:
        """Lets an agent act, or shows why it cannot."""
        try:
            made = self._makers[name]()
            self._session.play(made, self.parameters[name]() if name in self.parameters else None)
            self._message.content = ""
        except UserError as error:
            self._message.content = f"**{error}**"

    def replay(self, tape: Iterator[Frame]) -> None:
        """Shows a tape, even if the session is paused."""
        self._session.replay(tape)
        if not self._session.running:
            self._pause()

    def _pause(self) -> None:
        self._session.running = not self._session.running
        self._run.label = "Pause" if self._session.running else "Run"

    def _add_sliders(self) -> list:
        model, robots = self._session.env.physics_model, self._session.env.team
        sliders = []
        for name, home in zip(team.joints(robots), team.home(robots), strict=True):
            low, high = (float(x) for x in model.joint(name).range)
            sliders.append(self._gui.add_slider(name, min=low, max=high, step=(high - low) / 1000, initial_value=home))
            sliders[-1].on_update(lambda _: self._orders.give("slid", self._slid))
        return sliders

    def _slid(self) -> None:
        if self.agent.value != SLIDERS:
            self.agent.value = SLIDERS
        self._session.params = self._slid_to()

    def _slid_to(self) -> jax.Array:
        return jnp.array([s.value for s in self._sliders], jnp.float32)

    def _tell(self, frame: Frame) -> None:
        session, env = self._session, self._session.env
        done = list(session.successes)
        success = f"{sum(done) / len(done):.0%} of the last {len(done)} episodes" if done else "no episode has ended yet"
        self._status.content = (
            f"step {frame.step} of {env.episode_length}, {frame.step * env.dt:.1f} s\n\n"
            f"distance {100 * frame.distance:.1f} cm\n\nsuccess: {success}"
        )

    def _draw_curves(self) -> None:
        with self._drawing:  # pages and the session call from different threads
            self._draw(self._what.value)

    def _draw(self, what: str) -> None:
        group, _, term = what.partition(": ")
        frames = list(self._session.history) or [self._session.frame]
        values = {name: np.stack([f.curves[group][name] for f in frames]) for name in frames[-1].curves[group]}
        if term == "all":
            names, lines = list(values), np.concatenate(list(values.values()), axis=1).T
        else:
            lines = values[term].T
            names = [f"{term} {i}" if len(lines) > 1 else term for i in range(len(lines))]
        seconds = (np.arange(len(frames)) - len(frames) + 1) * self._session.env.dt
        data = (seconds, *lines)
        if self._plot is not None and self._shown == what:
            with contextlib.suppress(ValueError):
                self._plot.data = data
            return
        if self._plot is not None:
            self._plot.remove()
        self._shown = what
        styles = [{"label": name, "stroke": COLORS[i % len(COLORS)], "width": 1.5} for i, name in enumerate(names)]
        span = {"min": -CURVE * self._session.env.dt, "max": 0.0}
        self._plot = self._gui.add_uplot(
            data, ({"label": "s"}, *styles), aspect=1.3, scales={"x": {"time": False, "auto": False, "range": (span["min"], 0.0)}}
        )
