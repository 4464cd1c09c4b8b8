"""A page on which one clicks a place and watches the agent plan and go (NiceGUI; for this machine only)."""

import base64
import io
import itertools
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import gymnasium as gym
import imageio.v3 as imageio
import numpy as np
from nicegui import app, ui
from nicegui.events import MouseEventArguments

from sb3_skillgraph.agent import SkillGraphAgent
from sb3_skillgraph.envs import geometry_of
from sb3_skillgraph.explore.scene import Scene
from sb3_skillgraph.explore.session import Progress, Session, promised, record_of

HOST = "127.0.0.1"
#: Seconds between two looks at a run, and the steps in between, where nothing is rendered and where it is.
TICK, STEPS_A_TICK, STEPS_A_FRAME = 0.05, 2, 1
LOOK, START, GOAL = "look at an event", "start", "goal"


class Shown(NamedTuple):
    """What a page shows.

    :param agent: the agent
    :param make_env: makes an environment for a visitor, with ``render_mode="rgb_array"`` if it has that
    :param snapshots: of the graph as it grew: ``steps``, ``centers``, ``links``
    :param title: of the page
    """

    agent: SkillGraphAgent
    make_env: Callable[[], gym.Env]
    snapshots: list[dict[str, Any]]
    title: str


def serve(shown: Shown, port: int, show: bool) -> None:
    """Serve the page until Ctrl-C.

    :param shown: what it shows
    :param port: on 127.0.0.1
    :param show: whether to open a browser
    """

    @ui.page("/")
    def index() -> None:
        page = Page(shown)
        ui.context.client.on_delete(page.close)

    app.on_startup(lambda: print(f"look at http://{HOST}:{port}  (Ctrl-C ends)", flush=True))
    ui.run(host=HOST, port=port, reload=False, show=show, title=shown.title, show_welcome_message=False)


def as_jpeg(frame: np.ndarray) -> str:
    """Return a picture as a data URL.

    :param frame: shape ``(height, width, 3)``, uint8
    """
    file = io.BytesIO()
    imageio.imwrite(file, frame, extension=".jpg")
    return "data:image/jpeg;base64," + base64.b64encode(file.getvalue()).decode()


class Page:
    """What one visitor sees.

    :param shown: what is shown
    """

    def __init__(self, shown: Shown) -> None:
        self.shown = shown
        self.env = shown.make_env()
        self.session = Session(shown.agent, self.env)
        self.renders = self._can_render()
        self.dims = (0, min(1, shown.agent.graph.goal_dim - 1))
        self.scene = Scene(shown.agent, geometry_of(self.env), self.dims)
        self.run: Iterator[Progress] | None = None
        self.timer = ui.timer(TICK, self._tick, active=False)
        ui.label(shown.title).classes("text-h5")
        with ui.row(wrap=False):
            with ui.column():
                self._build_picture()
            with ui.column().style("width: 32rem"):
                self._build_panel()
        self._replan()

    def _can_render(self) -> bool:
        if self.env.render_mode != "rgb_array":
            return False
        try:
            return isinstance(self.env.render(), np.ndarray)
        except Exception as error:  # whatever a driver that is not there raises
            print(f"no rendered view: {error}", flush=True)
            return False

    # -- what is there ------------------------------------------------------------------------------------------------

    def _build_picture(self) -> None:
        agent = self.shown.agent
        with ui.row():
            ui.label("A click chooses")
            self.mode = ui.toggle([GOAL, START, LOOK], value=GOAL)
            self.go_button = ui.button("Go", on_click=self.go)
        if agent.graph.goal_dim > 2:
            names = {i: f"goal[{i}]" for i in range(agent.graph.goal_dim)}
            with ui.row():
                self.axes = [ui.select(names, value=dim, label=axis) for axis, dim in zip("xy", self.dims, strict=True)]
                for select in self.axes:
                    select.on_value_change(self._turn)
        width, height = self.scene.frame.size
        self.picture = ui.interactive_image(size=(width, height), on_mouse=self.click, sanitize=False)
        self.picture.style(f"width: {width}px; height: {height}px")
        key = "Dashed: the plan. Dotted: the next best. Coloured: runs of options, one after the other."
        ui.label(key).classes("text-caption")
        self.graph_layer, self.event_layer, self.plan_layer, self.run_layer = (self.picture.add_layer() for _ in range(4))
        self._draw_graph()
        if self.shown.snapshots:
            steps = [*(snapshot["steps"] for snapshot in self.shown.snapshots), "now"]
            ui.label("The graph as it grew")
            self.slider = ui.slider(min=0, max=len(steps) - 1, value=len(steps) - 1, on_change=self._draw_graph)
            ui.label().bind_text_from(
                self.slider, "value", lambda i: f"after {steps[int(i)]} steps" if i < len(steps) - 1 else "now"
            )

    def _build_panel(self) -> None:
        self.sentence = ui.label().classes("text-body1").mark("sentence")
        self.other = ui.label().classes("text-body2 text-grey-8")
        with ui.grid(columns=2):
            ui.label("Promised").classes("text-weight-bold")
            self.promise = ui.label().mark("promised")
            ui.label("Happened").classes("text-weight-bold")
            self.happened = ui.label("-").mark("happened")
        self.view = ui.image().style("width: 24rem")
        self.view.set_visibility(self.renders)
        if self.renders:
            self.view.set_source(as_jpeg(np.asarray(self.env.render())))
        self.record = ui.label().classes("text-weight-bold")
        self.reached_by = ui.label().classes("text-caption")
        self.table = ui.table(rows=[], columns=[], pagination=8).props("dense flat").style("width: 32rem")
        self.table.set_visibility(False)

    def _draw_graph(self) -> None:
        chosen = int(self.slider.value) if hasattr(self, "slider") else len(self.shown.snapshots)
        if chosen < len(self.shown.snapshots):
            snapshot = self.shown.snapshots[chosen]
            drawn = self.scene.growing(snapshot["centers"], snapshot["links"])
        else:
            drawn = self.scene.graph()
        self.graph_layer.set_content(self.scene.floor() + drawn)

    def _turn(self) -> None:
        """Show other dimensions of goal space."""
        self.dims = tuple(int(select.value) for select in self.axes)  # type: ignore[assignment]
        self.scene = Scene(self.shown.agent, geometry_of(self.env), self.dims)
        self._draw_graph()
        self._replan()

    # -- what is done -------------------------------------------------------------------------------------------------

    def click(self, mouse: MouseEventArguments) -> None:
        """Choose a start, a goal or an event."""
        if self.mode.value == LOOK:
            self._look(mouse.image_x, mouse.image_y)
            return
        self._stop()
        try:
            self.session.place(str(self.mode.value), self.dims, self.scene.frame.at(mouse.image_x, mouse.image_y))
        except ValueError as error:
            ui.notify(f"Not there: {error}", type="warning", multi_line=True)
        self._replan()

    def _look(self, x: float, y: float) -> None:
        event = self.scene.event_at(x, y)
        self.table.set_visibility(event is not None)
        if event is None:
            self.event_layer.set_content("")
            self.record.set_text("")
            self.reached_by.set_text("")
            return
        record = record_of(self.shown.agent, event, self.scene.links)
        self.event_layer.set_content(self.scene.selected(event))
        self.record.set_text(f"{record['id']}, a {record['kind']} at {record['center']}: options that begin here")
        self.reached_by.set_text(f"Options that lead here: {record['reached_by']}.")
        self.table.columns = (
            [{"name": name, "label": name, "field": name} for name in record["rows"][0]] if record["rows"] else []
        )
        self.table.rows = record["rows"]

    def _replan(self) -> None:
        session = self.session
        plan, other = session.plan(), session.next_best()
        self.sentence.set_text(str(plan))
        self.promise.set_text(promised(plan))
        self.happened.set_text("-")
        self.other.set_text("" if other is None else f"Next best: {other}")
        lines = [self.scene.plan(session.start, session.goal, plan.path)]
        if other is not None:
            lines.append(self.scene.plan(session.start, session.goal, other.path, "2 6"))
        self.plan_layer.set_content("".join([*lines, self.scene.ends(session.start, session.goal)]))
        self.run_layer.set_content("")

    def go(self) -> None:
        """Follow the plan in the environment."""
        self._replan()
        self.run = self.session.go()
        self.timer.activate()

    def _tick(self) -> None:
        if self.run is None:
            return
        try:
            done = list(itertools.islice(self.run, STEPS_A_FRAME if self.renders else STEPS_A_TICK))
        except Exception as error:  # whatever the environment raises
            self.happened.set_text(f"the environment failed: {error}")
            self._stop()
            return
        if not done:  # there from the beginning
            self.happened.set_text("the goal is where the start is")
            self._stop()
            return
        progress = done[-1]
        self.run_layer.set_content(self.scene.trace(progress.points, progress.options))
        if self.renders:
            self.view.set_source(as_jpeg(np.asarray(self.env.render())))
        self.happened.set_text(f"{len(progress.options)} steps: {progress.options[-1]}")
        if progress.over:
            self.happened.set_text(progress.outcome)
            self._stop()

    def _stop(self) -> None:
        self.run = None
        self.timer.deactivate()

    def close(self) -> None:
        """Let go of everything when the visitor has left."""
        self._stop()
        self.session.close()
