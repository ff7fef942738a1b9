"""The operator's page: what runs there are, and one run with its scene, states, interlocks, contacts and buttons."""

from __future__ import annotations

import base64
from collections.abc import Awaitable
from pathlib import Path
from typing import Any, Final

import numpy as np
from nicegui import run as background
from nicegui import ui

from touchcell.cell.analysis.trip_report import explain
from touchcell.cell.recording.mcap import RECORDING
from touchcell.cell.runtime.black_box import RING
from touchcell.cell.runtime.operator_channel import OperatorRequest
from touchcell.cell.ui.jog_pad import JogPad
from touchcell.cell.ui.jog_relay import takes_jog
from touchcell.cell.ui.run_view import Moment, RunView, sources
from touchcell.cell.ui.runs import Runs, StartedRun, outcome
from touchcell.errors import TouchcellError
from touchcell.geometry import se3
from touchcell.geometry.solids import Polyline
from touchcell.geometry.types import Array
from touchcell.tasks.state_machine import Table, mermaid

_REFRESH_S: Final = 0.2
_SLOWLY: Final = 5
"""Refreshes from one look at the run's files to the next."""
_COLOURS: Final = {
    "done": "positive",
    "stopped": "grey",
    "failed": "warning",
    "tripped": "negative",
    "error": "negative",
}
_UNITS: Final = {"mm": "mm", "deg": "°"}
_CONTACT_RADIUS_M: Final = 0.004
_COLUMN: Final = "contents lg:flex lg:flex-col gap-2 min-w-0"
_NEAREST_M: Final = 0.42
"""Distance of the camera from a cell whose arms are drawn by their last links only."""


def build_list(runs: Runs) -> None:
    """Build the page that lists runs and cells."""
    _header("touchcell")
    with ui.column().classes("w-full max-w-4xl mx-auto p-2 gap-4"):
        with ui.card().classes("w-full"):
            ui.label("Start a run on simulated devices").classes("text-lg font-medium")
            cells = runs.cells()

            def chosen_cell() -> Path | None:
                return cells.get(chosen.value)

            with ui.row().classes("w-full items-center"):
                chosen = ui.select(list(cells), label="cell", with_input=True).classes("grow")
                ui.button("start", icon="play_arrow", on_click=lambda: _start(runs, chosen_cell()))
                jog = ui.button("move by hand", icon="open_with")
                jog.props("outline").on_click(lambda: _start(runs, chosen_cell(), by_hand=True))
        with ui.card().classes("w-full"):
            ui.label(f"Runs in {runs.root}").classes("text-lg font-medium")
            place = ui.column().classes("w-full gap-1")
    shown: list[Any] = [None]

    def refresh() -> None:
        found = runs.listed()
        if found == shown[0]:
            return
        shown[0] = found
        place.clear()
        with place:
            if not found:
                ui.label("none yet").classes("text-gray-500")
            for each in found:
                with ui.row().classes("w-full items-center no-wrap"):
                    ui.link(each.name, f"/run/{each.name}").classes("grow break-all")
                    if each.running:
                        ui.badge("in progress", color="primary")
                    else:
                        ui.badge(each.outcome or "cut off", color=_COLOURS.get(each.outcome, "grey"))

    refresh()
    ui.timer(1.0, refresh)


async def _start(runs: Runs, cell: Path | None, *, by_hand: bool = False) -> None:
    if cell is None:
        ui.notify("choose a cell first")
        return
    started = runs.start(cell, by_hand=by_hand)
    if isinstance(started, str):
        ui.notify(started, type="negative")
        return
    ui.notify(f"{started.name}: starting")
    _go_when_begun(runs, started)


def _go_when_begun(runs: Runs, started: StartedRun) -> None:
    def look() -> None:
        reason = started.failure()
        if runs.has_begun(started.name):
            started.has_begun()
            ui.navigate.to(f"/run/{started.name}")
        elif reason:
            ui.notify(reason, type="negative", multi_line=True)
        if reason or runs.has_begun(started.name):
            timer.cancel()

    timer = ui.timer(0.3, look)


def build_run(runs: Runs, name: str, source: str = RECORDING) -> None:
    """Build the page of one run, from its recording or one of its black boxes."""
    try:
        view = runs.view(name, source)
    except TouchcellError as error:
        _header(name)
        ui.label(str(error)).classes("p-4")
        return
    if view is None:
        _header(name)
        ui.label("there is no such run").classes("p-4")
        return
    RunPage(runs, name, view)


class RunPage:
    """One open page of one run: its widgets, and what keeps them up to date.

    Args:
        runs: for the buttons.
        name: of the run.
        view: of its recording.
    """

    def __init__(self, runs: Runs, name: str, view: RunView) -> None:
        self._runs = runs
        self._name = name
        self._view = view
        self._ticks = 0
        self._was_running: bool | None = None
        self._was_waiting = False
        self._shown_sources: list[str] = []
        self._t_s: float | None = None
        self._drawn: dict[str, Array] = {}
        self._table = _table(view)
        self._build()
        ui.timer(_REFRESH_S, self._refresh)

    def _build(self) -> None:
        with _header(self._name):
            self._state = ui.badge("…").classes("text-base").props("color=primary")
        with ui.column().classes("w-full max-w-screen-2xl mx-auto p-2 gap-2"):
            self._sources = ui.row().classes("w-full items-center gap-3")
            self._buttons()
            with ui.card().classes("w-full bg-red-1") as self._trip:
                self._cause = ui.label().classes("whitespace-pre-wrap font-mono text-sm break-words")
            self._trip.visible = False
            # Two columns, so that no card waits for a taller one beside it; a phone has one, in this order.
            with ui.element("div").classes("w-full grid grid-cols-1 lg:grid-cols-2 gap-2 items-start"):
                with ui.element("div").classes(_COLUMN):
                    with ui.card().classes("w-full min-w-0 order-1"):
                        self._scene = self._build_scene()
                    with ui.card().classes("w-full min-w-0 order-3"):
                        _title("Contacts")
                        self._contacts = ui.html("", sanitize=False).classes("w-full overflow-x-auto")
                        with ui.row().classes("w-full gap-2"):
                            self._images = {
                                sensor: ui.image().classes("w-full max-w-sm") for sensor in self._view.plan.sensor_roles
                            }
                        self._no_images = ui.label().classes("text-gray-500")
                with ui.element("div").classes(_COLUMN):
                    self._jog: JogPad | None = None
                    if self._view.plan.task.name == "jog":
                        with ui.card().classes("w-full min-w-0 order-2") as self._jog_card:
                            _title("Move by hand")
                    with ui.card().classes("w-full min-w-0 order-4"):
                        _title("Interlocks")
                        self._bars = _Bars()
                    with ui.card().classes("w-full min-w-0 order-5"):
                        _title("Events")
                        self._events = ui.label().classes("whitespace-pre-wrap font-mono text-xs break-words")
                # Over both columns: its labels are read, not only its shape.
                with ui.card().classes("w-full min-w-0 order-6 lg:col-span-2"):
                    _title("States")
                    self._diagram = ui.mermaid(_diagram(self._table, "")).classes("w-full overflow-x-auto")
                    self._shown_state = ""
                with ui.card().classes("w-full min-w-0 order-7 lg:col-span-2"):
                    _title("Devices")
                    self._health = ui.html("", sanitize=False).classes("w-full overflow-x-auto")
        self._scrub = ui.footer(value=False).classes("bg-white text-black px-3 py-1 shadow-2")
        with self._scrub, ui.row().classes("w-full items-center no-wrap"):
            ui.button(icon="play_arrow", on_click=self._toggle).props("round dense")
            self._slider = ui.slider(min=0.0, max=1.0, step=0.01, value=0.0, on_change=self._moved).classes("grow")
            self._time = ui.label("0.00 s").classes("w-20 text-right")
        self._playing = False

    def _buttons(self) -> None:
        with ui.row().classes("w-full gap-2") as self._controls:
            stop = ui.button("stop", icon="pan_tool", on_click=lambda: self._stop(at_once=False))
            stop.props("color=warning").mark("stop")
            now = ui.button("stop at once", icon="dangerous", on_click=lambda: self._stop(at_once=True))
            now.props("color=negative").mark("stop-at-once")
            self._reset = ui.button("reset", icon="restart_alt", on_click=lambda: self._ask(OperatorRequest.RESET))
            self._resume = ui.button("resume", icon="play_arrow", on_click=lambda: self._ask(OperatorRequest.RESUME))
            for button in (self._reset, self._resume):
                button.props("color=primary").disable()
        self._controls.visible = False

    def _stop(self, *, at_once: bool) -> None:
        ui.notify(self._runs.stop(self._name, at_once=at_once))

    async def _ask(self, request: OperatorRequest) -> None:
        question = {
            OperatorRequest.RESET: "Has the cause gone, and is it safe to clear this trip? Nothing moves by it.",
            OperatorRequest.RESUME: "The task starts again from its first state, and the arms will move. Is that safe?",
        }[request]
        if await _confirmed(question, request.value):
            ui.notify(await background.io_bound(self._runs.ask, self._name, request))

    async def _refresh(self) -> None:
        view = self._view
        if self._ticks % _SLOWLY == 0:
            self._look_at_run()
        self._ticks += 1
        end_s = view.end_s
        if end_s is not None and not self._scrub.value:
            self._scrub.show()
            self._slider.props(f"max={end_s:.2f}")
            self._slider.value = self._t_s = end_s
        if self._playing and end_s is not None:
            self._slider.value = min((self._t_s or 0.0) + _REFRESH_S, end_s)
            self._playing = self._slider.value < end_s
        elif end_s is not None and self._ticks % _SLOWLY:
            return
        # In a thread: what an operator holds on this page is passed on meanwhile.
        moment = await background.io_bound(view.moment, self._t_s)
        if moment is not None:
            self._show(moment)
        elif view.problem:
            self._events.text = view.problem

    def _show_sources(self, found: list[str]) -> None:
        """Offer the recording and the black boxes, where there are any."""
        if found == self._shown_sources:
            return
        self._shown_sources = found
        self._sources.clear()
        with self._sources:
            for source in found if len(found) > 1 else ():
                if source == self._view.source:
                    ui.label(_source_title(source)).classes("font-medium")
                else:
                    ui.link(_source_title(source), f"/run/{self._name}/{source}")

    def _look_at_run(self) -> None:
        """Read from the run's folder whether it is in progress, waits, or has tripped."""
        self._show_sources(sources(self._view.folder))
        running, waiting = self._view.running, self._view.waiting
        self._controls.visible = running
        self._show_jog(running and takes_jog(self._view.folder))
        self._reset.set_enabled(waiting)
        self._resume.set_enabled(waiting)
        ended = outcome(self._view.folder)
        if waiting != self._was_waiting or running != self._was_running:
            self._was_waiting, self._was_running = waiting, running
            if waiting or ended in ("tripped", "failed", "error"):
                ui.timer(0.1, self._explain, once=True)
            else:
                self._trip.visible = False

    def _show_jog(self, moves: bool) -> None:
        """Show the buttons that move an arm while the run takes them."""
        if self._view.plan.task.name != "jog":
            return
        self._jog_card.visible = moves
        if moves and self._jog is None:
            with self._jog_card:
                self._jog = JogPad(self._name, list(self._view.plan.arm_roles))
        elif not moves and self._jog is not None:
            self._jog.delete()
            self._jog = None

    async def _explain(self) -> None:
        try:
            text = await background.io_bound(lambda: explain(self._view.folder, draw=False))
        except TouchcellError as error:
            text = str(error)
        if text is not None:
            self._cause.text = text
            self._trip.visible = True

    def _moved(self) -> None:
        self._t_s = float(self._slider.value)
        self._time.text = f"{self._t_s:.2f} s"
        if (moment := self._view.moment(self._t_s)) is not None:
            self._show(moment)

    def _toggle(self) -> None:
        self._playing = not self._playing
        if self._playing and self._t_s == self._view.end_s:
            self._slider.value = self._t_s = 0.0

    def _show(self, moment: Moment) -> None:
        # The recording's last messages may still be on their way when a run begins to wait.
        state = "tripped" if self._was_waiting else moment.state
        waits = ", waits for reset" if self._was_waiting else ""
        ended = "" if self._was_running else f" · {outcome(self._view.folder) or 'cut off'}"
        self._state.text = f"{state or '…'}{waits}  {moment.t_s:.2f} s{ended}"
        self._bars.show(moment)
        self._contacts.content = _contact_table(moment)
        self._health.content = _health_table(moment)
        self._events.text = "\n".join(moment.events)
        if state != self._shown_state:
            self._shown_state = state
            self._diagram.content = _diagram(self._table, state)
        self._show_pictures()
        self._move(moment)

    def _show_pictures(self) -> None:
        found = False
        for sensor, image in self._images.items():
            picture = self._view.picture(sensor, self._t_s)
            image.visible = picture is not None
            if picture is not None:
                found = True
                image.source = f"data:image/jpeg;base64,{base64.b64encode(picture).decode()}"
        self._no_images.text = (
            "" if found else "no image yet; recorded with `recording: {frames: jpeg}` in the cell file"
        )

    def _build_scene(self) -> Any:
        _title("Cell")
        self._groups: dict[str, Any] = {}
        self._marks: dict[str, Any] = {}
        scene = self._view.scene
        if scene is None:
            ui.label("this cell cannot be drawn")
            return None
        element = ui.scene(width=600, height=420, grid=(1, 10), background_color="#f7f7f7", fps=8).classes("w-full")
        with element:
            for number, part in enumerate(scene.parts):
                if part.frame not in self._groups:
                    self._groups[part.frame] = element.group()
                with self._groups[part.frame]:
                    _draw(element, part, f"/part/{self._name}/{number}.stl")
            for sensor in self._view.plan.sensor_roles:
                self._marks[sensor] = element.sphere(_CONTACT_RADIUS_M).material("#e0102f").visible(False)
        return element

    def _move(self, moment: Moment) -> None:
        """Put every frame of the scene where it is now."""
        scene = self._view.scene
        if self._scene is None or scene is None:
            return
        first = not self._drawn
        for frame, group in self._groups.items():
            T = moment.poses.get(frame)
            before = self._drawn.get(frame)
            if T is None or not np.isfinite(T).all() or (before is not None and np.allclose(T, before, atol=1e-6)):
                continue
            self._drawn[frame] = T
            group.move(*T[:3, 3].tolist())
            group.rotate_R(T[:3, :3].tolist())
        for row in moment.contacts:
            mark, T_world_sensor = self._marks.get(row.sensor), moment.poses.get(f"sensors/{row.sensor}")
            if mark is None or T_world_sensor is None:
                continue
            mark.visible(row.in_contact and len(row.values) == 6)
            if row.in_contact and len(row.values) == 6:
                T_f_s = se3.from_euler_mm_deg(np.array([value for _, value, _ in row.values]))
                mark.move(*(T_world_sensor @ se3.inverse(T_f_s))[:3, 3].tolist())
        if first and self._drawn:
            # Of boxes and paths, and of bases where nothing is drawn, the view need not be full.
            solid = {part.frame for part in scene.parts if not isinstance(part.solid, Polyline)} - {"world"}
            points = np.array([T[:3, 3] for frame, T in self._drawn.items() if frame in solid] or [np.zeros(3)])
            low, high = points.min(axis=0), points.max(axis=0)
            x, y, z = (0.5 * (low + high)).tolist()
            # Twice the distance at which what moves would fill the view: links reach beyond their frames.
            away = max(_NEAREST_M, 1.6 * float(np.linalg.norm(high - low)))
            self._scene.move_camera(x + 0.52 * away, y - 0.7 * away, z + 0.48 * away, x, y, z, duration=0.0)


class _Bars:
    """One bar for each quantity of each interlock."""

    def __init__(self) -> None:
        self._place = ui.column().classes("w-full gap-1")
        self._rows: dict[tuple[str, str], tuple[Any, Any]] = {}

    def show(self, moment: Moment) -> None:
        """Show how far each is on its way to its limit."""
        keys = [(bar.interlock, bar.subject) for bar in moment.bars]
        if keys != list(self._rows):
            self._place.clear()
            self._rows = {}
            with self._place:
                for key in keys:
                    with ui.column().classes("w-full gap-0"):
                        label = ui.label().classes("text-xs")
                        line = ui.linear_progress(0.0, show_value=False, size="8px").props("instant-feedback")
                    self._rows[key] = label, line
        for bar in moment.bars:
            label, line = self._rows[bar.interlock, bar.subject]
            label.text = f"{bar.interlock}{f' · {bar.subject}' if bar.subject else ''} — {bar.text}"
            line.visible = bar.fraction is not None
            if bar.fraction is not None:
                line.value = round(bar.fraction, 3)
                colour = "negative" if bar.fraction >= 1.0 else "warning" if bar.fraction >= 0.7 else "positive"
                line.props(f"color={colour}")


def _header(text: str) -> Any:
    header = ui.header().classes("items-center gap-2 px-3 py-1")
    with header:
        ui.link("touchcell", "/").classes("text-white text-lg font-medium no-underline")
        if text != "touchcell":
            ui.label(text).classes("grow truncate")
    return header


def _source_title(source: str) -> str:
    """Return what a source is called: recording, black box, black box 1."""
    if source == RECORDING:
        return "recording"
    number = source.removesuffix(".mcap").partition("-")[2]
    return f"black box {number}" if number else "black box (left by a crash)" if source == RING else "black box"


def _title(text: str) -> None:
    ui.label(text).classes("text-base font-medium")


async def _confirmed(question: str, action: str) -> bool:
    with ui.dialog() as dialog, ui.card():
        ui.label(question)
        with ui.row():
            ui.button(f"yes, {action}", on_click=lambda: dialog.submit(True))
            ui.button("no", on_click=lambda: dialog.submit(False)).props("flat")
    answer: Awaitable[Any] = dialog
    return bool(await answer)


def _draw(scene: Any, part: Any, url: str) -> None:
    red, green, blue, opacity = part.colour
    colour = "#" + "".join(f"{round(255 * each):02x}" for each in (red, green, blue))
    T = part.T_frame_solid
    if isinstance(part.solid, Polyline):
        points = part.solid.points_m @ T[:3, :3].T + T[:3, 3]
        for start, end in zip(points[:-1].tolist(), points[1:].tolist(), strict=True):
            scene.line(start, end).material(colour, opacity)
        return
    drawn = scene.stl(url).material(colour, opacity)
    drawn.move(*T[:3, 3].tolist()).rotate_R(T[:3, :3].tolist())


def _contact_table(moment: Moment) -> str:
    rows = []
    for row in moment.contacts:
        if not row.values:
            rows.append(
                f"<tr><td>{_safe(row.sensor)}</td><td colspan=6>{'touches' if row.in_contact else 'free'}</td></tr>"
            )
            continue
        cells = "".join(
            f"<td>{value:.2f} <span style='color:#888'>± {sigma:.2f}</span></td>" for _, value, sigma in row.values
        )
        rows.append(f"<tr><td>{_safe(row.sensor)}</td>{cells}</tr>")
    names = "".join(f"<th>{name.partition('_')[0]} {_UNITS[name.rpartition('_')[2]]}</th>" for name in _COMPONENTS)
    return f"<table class='w-full text-left text-sm'><tr><th></th>{names}</tr>{''.join(rows)}</table>"


_COMPONENTS: Final = ("x_mm", "y_mm", "z_mm", "alpha_deg", "beta_deg", "gamma_deg")


def _health_table(moment: Moment) -> str:
    rows = [
        f"<tr><td class='pr-4'>{_safe(device)}</td><td class='pr-4'>{_safe(key)}</td>"
        f"<td>{_safe(_short(value))}</td></tr>"
        for device, readings in moment.health.items()
        for key, value in readings.items()
    ]
    return f"<table class='text-left text-sm'>{''.join(rows)}</table>" if rows else "nothing reported yet"


def _short(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _safe(text: str) -> str:
    return text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")


def _table(view: RunView) -> Table | None:
    """Return the states of a run's task; None for a task that is no state machine."""
    from touchcell.cell.config.armed import built_task

    table = getattr(built_task(view.plan), "table", None)
    return table if isinstance(table, Table) else None


def _diagram(table: Table | None, state: str) -> str:
    """Return the states as a Mermaid diagram, the present one filled."""
    if table is None:
        return f"stateDiagram-v2\n    [*] --> {state or 'task'}"
    drawn = mermaid(table)
    if state:
        drawn += f"\n    classDef present fill:#ffb300,stroke:#e65100,stroke-width:3px\n    class {state} present"
    return drawn
