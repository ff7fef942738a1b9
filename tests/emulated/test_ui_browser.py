"""The operator's page in a real browser: what it shows, and what its buttons do to a run."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from touchcell.cell.config.true_contact import put_on_true_contact
from touchcell.paths import CONFIGS

sync_api = pytest.importorskip("playwright.sync_api")
pytest.importorskip("nicegui")
CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")
# A browser that draws three dimensions without a GPU takes both cores of a small machine.
takes_both_cores = pytest.mark.exhaustive
DEADLINE_S = 60.0
ENVIRONMENT = os.environ | {"OMP_NUM_THREADS": "1"}


@pytest.fixture(scope="module")
def playwright() -> Iterator[Any]:
    with sync_api.sync_playwright() as playwright:
        yield playwright


@pytest.fixture(scope="module")
def browser(playwright: Any) -> Iterator[Any]:
    options = ["--no-sandbox", "--use-gl=swiftshader", "--enable-unsafe-swiftshader"]
    browser = playwright.chromium.launch(executable_path=CHROMIUM, args=options)
    yield browser
    browser.close()


@pytest.fixture(scope="module")
def flat_browser(playwright: Any) -> Iterator[Any]:
    """One that draws nothing in three dimensions, for what has deadlines."""
    browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", "--disable-3d-apis"])
    yield browser
    browser.close()


class Process:
    """``touchcell ARGUMENTS`` with its output in a file."""

    def __init__(self, folder: Path, *arguments: str) -> None:
        self.log = folder / f"{arguments[0]}.log"
        with self.log.open("wb") as stream:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "touchcell", *arguments],
                cwd=folder,
                stdin=subprocess.DEVNULL,
                stdout=stream,
                stderr=stream,
                env=ENVIRONMENT,
            )

    def address(self) -> str:
        self.until(lambda: "token=" in self.log.read_text())
        found = re.search(r"http://\S+", self.log.read_text())
        assert found is not None
        return found[0]

    def until(self, condition: Callable[[], bool]) -> None:
        end_s = time.monotonic() + DEADLINE_S
        while not condition():
            assert time.monotonic() < end_s, self.log.read_text()
            time.sleep(0.05)

    def end(self) -> None:
        self.process.terminate()
        self.process.wait(30)


def cell(folder: Path, **changes: Any) -> Path:
    """A cell in real time, with limits that a busy machine keeps."""
    data = yaml.safe_load((CONFIGS / "surface_follow_sim.yaml").read_text())
    put_on_true_contact(data)
    data |= {"time": "real", "rate_hz": 25, **changes}
    data["interlocks"]["stale_arm"]["limit_ms"] = 900
    data["interlocks"]["stale_frame"]["limit_ms"] = 900
    data["interlocks"]["overrun"] = {"kind": "overrun", "limit_ms": 900}
    data["interlocks"].pop("tracking", None)
    data["interlocks"].pop("limited", None)
    data["task"] |= {"speed_mm_s": 3, "max_state_age_ms": 800, "max_frame_age_ms": 800, "stale_timeout_s": 2}
    path = folder / "cell.yaml"
    path.write_text(yaml.safe_dump(data))
    return path


def test_a_recording_is_shown_and_scrubbed_and_tabs_come_and_go(browser: Any, tmp_path: Path) -> None:
    out = tmp_path / "runs" / "first"
    settings = [word for each in ("task.distance_mm=3", "task.retract_mm=5") for word in ("--set", each)]
    path = tmp_path / "cell.yaml"
    data = yaml.safe_load((CONFIGS / "surface_follow_sim.yaml").read_text())
    put_on_true_contact(data)
    path.write_text(yaml.safe_dump(data))
    command = [sys.executable, "-m", "touchcell", "run", str(path), "--quiet", "--out", str(out), *settings]
    subprocess.run(command, check=True, env=ENVIRONMENT, capture_output=True)
    server = Process(tmp_path, "ui", "--port", "0")
    try:
        address = server.address()
        page = browser.new_page(viewport={"width": 390, "height": 800})
        page.set_default_timeout(1e3 * DEADLINE_S)
        errors: list[str] = []
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.goto(address)
        assert "token" not in page.url
        page.get_by_text("first", exact=True).click()
        page.get_by_text("indentation").first.wait_for()
        page.locator("canvas").first.wait_for()
        page.locator("svg .present").first.wait_for(state="attached")
        assert page.evaluate("document.documentElement.scrollWidth") <= 390
        before = page.locator(".q-badge").first.inner_text()
        page.locator(".q-slider").first.click(position={"x": 60, "y": 10})
        page.wait_for_function("text => document.querySelector('.q-badge').innerText !== text", arg=before)
        for _ in range(4):
            tab = browser.new_page()
            tab.goto(address.replace("/?", "/run/first?"))
            tab.close()
        page.reload()
        page.get_by_text("indentation").first.wait_for()
        page.close()
        fresh = browser.new_context().new_page()
        assert fresh.goto(address.partition("?")[0]).status == 401
        assert errors == []
    finally:
        server.end()
    assert "Traceback" not in server.log.read_text()


@takes_both_cores
def test_stop_at_once_on_the_page_brings_the_arm_to_rest_in_its_declared_time(browser: Any, tmp_path: Path) -> None:
    out = tmp_path / "runs" / "live"
    run = Process(tmp_path, "run", str(cell(tmp_path)), "--quiet", "--ui", "--out", str(out))
    try:
        page = browser.new_page()
        page.set_default_timeout(1e3 * DEADLINE_S)
        page.goto(run.address())
        page.get_by_text("approach", exact=False).first.wait_for()
        page.get_by_role("button", name="stop at once").click()
        run.until(lambda: run.process.poll() is not None)
    finally:
        run.end()
    result = json.loads((out / "result.json").read_text())
    assert result["outcome"] == "stopped", run.log.read_text()
    stop = result["stops"]["arm"]
    assert stop["time_s"] <= stop["declared_s"] + 0.04
    assert "Traceback" not in run.log.read_text()


@takes_both_cores
def test_reset_and_resume_on_the_page(browser: Any, tmp_path: Path) -> None:
    out = tmp_path / "runs" / "waits"
    path = cell(tmp_path, on_trip="wait_for_reset")
    run = Process(tmp_path, "run", str(path), "--quiet", "--ui", "--out", str(out))
    try:
        page = browser.new_page()
        page.set_default_timeout(1e3 * DEADLINE_S)
        page.goto(run.address())
        page.get_by_text("prepare → approach", exact=False).first.wait_for()
        # A loop that hangs trips; when it goes on, the cause has gone.
        run.process.send_signal(signal.SIGSTOP)
        time.sleep(1.5)
        run.process.send_signal(signal.SIGCONT)
        page.get_by_text("first cause", exact=False).first.wait_for()
        place = tool_of(page)
        page.get_by_role("button", name="reset", exact=True).click()
        page.get_by_role("button", name="yes, reset").click()
        page.get_by_text("nothing moves until", exact=False).first.wait_for()
        assert tool_of(page) == place
        page.get_by_role("button", name="resume", exact=True).click()
        page.get_by_role("button", name="yes, resume").click()
        page.get_by_text("starts again", exact=False).first.wait_for()
        page.get_by_role("button", name="stop", exact=True).click()
        run.until(lambda: run.process.poll() is not None)
    finally:
        run.end()
    [reset] = json.loads((out / "result.json").read_text())["resets"]
    assert reset["causes"]
    assert "Traceback" not in run.log.read_text()


def tool_of(page: Any) -> str:
    """The bar of the workspace, which says where the tool is."""
    return str(page.get_by_text("inside the workspace", exact=False).first.inner_text())


def text_of(page: Any) -> str:
    """What the buttons that move an arm show: its state and its pose."""
    return str(page.locator(".text-mono").first.inner_text())


def z_of(page: Any) -> float:
    found = re.search(r"z (-?[\d.]+)", text_of(page))
    assert found is not None, text_of(page)
    return float(found[1])


def idle(page: Any) -> None:
    page.wait_for_function("document.querySelector('.text-mono')?.innerText.startsWith('idle')")


@takes_both_cores
def test_an_arm_is_moved_from_the_page_for_as_long_as_a_button_is_held(flat_browser: Any, tmp_path: Path) -> None:
    out = tmp_path / "runs" / "jog"
    jog = Process(tmp_path, "jog", str(cell(tmp_path, time="simulated")), "--ui", "--out", str(out))
    try:
        address = jog.address()
        context = flat_browser.new_context(viewport={"width": 390, "height": 800})
        page = context.new_page()
        page.set_default_timeout(1e3 * DEADLINE_S)
        page.goto(address)
        idle(page)
        start_mm = z_of(page)
        page.locator("[data-jog='z+']").scroll_into_view_if_needed()
        box = page.locator("[data-jog='z+']").bounding_box()
        page.mouse.move(box["x"] + 8, box["y"] + 8)
        page.mouse.down()
        jog.until(lambda: z_of(page) > start_mm + 1.0)
        # Off the button is let go, pressed or not.
        page.mouse.move(box["x"] + 8, box["y"] - 100)
        idle(page)
        held_mm = z_of(page)
        page.mouse.up()
        page.keyboard.down("o")
        jog.until(lambda: z_of(page) > held_mm + 1.0)
        page.keyboard.up("o")
        idle(page)
        # A tab that is closed while it is held lets go.
        page.mouse.move(box["x"] + 8, box["y"] + 8)
        page.mouse.down()
        before_mm = z_of(page)
        jog.until(lambda: z_of(page) > before_mm + 1.0)
        page.close()
        again = context.new_page()
        again.set_default_timeout(1e3 * DEADLINE_S)
        again.goto(address)
        idle(again)
        rest_mm = z_of(again)
        again.get_by_text("hold", exact=True).wait_for()
        again.get_by_text("step", exact=True).click()
        again.locator("[data-jog='z+']").click()
        jog.until(lambda: abs(z_of(again) - rest_mm - 1.0) < 0.06)
        idle(again)
        again.on("dialog", lambda dialog: dialog.accept())
        again.locator("input[placeholder^='start']").fill("start")
        again.get_by_role("button", name="save").click()
        again.get_by_text("saved arms.arm.start_pose_mm_deg").wait_for()
        again.get_by_role("button", name="stop", exact=True).click()
        assert jog.process.wait(DEADLINE_S) == 0
    finally:
        jog.end()
    assert "Traceback" not in jog.log.read_text()
    start = yaml.safe_load((tmp_path / "cell.yaml").read_text())["arms"]["arm"]["start_pose_mm_deg"]
    assert start[2] == pytest.approx(rest_mm + 1.0, abs=0.1)


@takes_both_cores
@pytest.mark.timeout(300)
def test_a_hundred_reloads_and_vanishing_tabs_leave_no_traceback(flat_browser: Any, tmp_path: Path) -> None:
    out = tmp_path / "runs" / "jog"
    jog = Process(tmp_path, "jog", str(cell(tmp_path, time="simulated")), "--ui", "--out", str(out))
    try:
        address = jog.address()
        context = flat_browser.new_context()
        page = context.new_page()
        page.set_default_timeout(1e3 * DEADLINE_S)
        page.goto(address)
        idle(page)
        for k in range(100):
            # Some are gone before their WebSocket is open, others while it is.
            page.goto(address, wait_until=("commit", "domcontentloaded")[k % 2])
            if k % 10 == 0:
                page.goto("about:blank")
        page.goto(address)
        idle(page)
        page.get_by_role("button", name="stop", exact=True).click()
        assert jog.process.wait(DEADLINE_S) == 0
    finally:
        jog.end()
    text = jog.log.read_text()
    assert "Traceback" not in text
    assert "rror" not in text


@takes_both_cores
@pytest.mark.timeout(600)
# A replay shows images of a data set, which does not ship.
@pytest.mark.parametrize("name", sorted({path.name for path in CONFIGS.glob("*.yaml")} - {"replay_real.yaml"}))
def test_every_shipped_cell_is_shown_at_the_width_of_a_phone_and_of_a_desk(
    browser: Any, tmp_path: Path, name: str
) -> None:
    out = tmp_path / "runs" / "shown"
    command = [sys.executable, "-m", "touchcell", "run", name, "--on", "sim", "--quiet", "--out", str(out)]
    command += ["--set", "max_duration_s=1.5", "--set", "recording.frames=jpeg"]
    done = subprocess.run(command, cwd=tmp_path, env=ENVIRONMENT, capture_output=True, text=True, check=False)
    assert (out / "run.mcap").stat().st_size > 10_000, done.stderr
    interlocks = yaml.safe_load((out / "cell.yaml").read_text()).get("interlocks", {})
    server = Process(tmp_path, "ui", "runs/shown", "--port", "0")
    try:
        address = server.address()
        for width in (390, 1280):
            page = browser.new_page(viewport={"width": width, "height": 900})
            page.set_default_timeout(1e3 * DEADLINE_S)
            errors: list[str] = []
            page.on("pageerror", lambda error, errors=errors: errors.append(str(error)))
            page.goto(address, wait_until="domcontentloaded")
            page.get_by_text(re.compile(r"\d s · ")).first.wait_for()
            page.locator("svg .present").first.wait_for(state="attached")
            for interlock in interlocks:
                page.get_by_text(re.compile(rf"^{interlock}\b")).first.wait_for()
            assert page.evaluate("document.documentElement.scrollWidth") <= width
            assert errors == []
            page.close()
    finally:
        server.end()
    assert "Traceback" not in server.log.read_text()
