"""What an adversarial audit and a first user found in version 0.1.0, and what each reproduction gives then and now.

``python -m benchmarks findings [--against CHECKOUT] [ROW ...]`` runs one small reproduction for each row and prints a
table: what was found, what 0.1.0 does, what happens now. With a checkout of 0.1.0 that has its own ``.venv``, the same
is tried there (``tests/earlier``); without, what was recorded then is printed. Rows S are of safety, R of reliability
and evidence, a of use.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import getpass
import hashlib
import io
import json
import logging
import os
import subprocess
import sys
import tempfile
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from tests.fault_injection import findings_cells as cells_of
from tests.fault_injection import fuzz_cells, fuzz_recordings
from tests.helpers.operated_run import OperatedRun, waiting_cell
from touchcell.cell.bench.provenance import provenance
from touchcell.cell.cli.main import main
from touchcell.cell.config.schema import plan_cell
from touchcell.cell.config.true_contact import put_on_true_contact
from touchcell.cell.recording.mcap import Damage, read
from touchcell.cell.runtime.black_box import read_left_ring
from touchcell.cell.runtime.operator_channel import OperatorChannel
from touchcell.cell.runtime.operator_input import stop_on_keys
from touchcell.cell.runtime.stop_request import StopRequest
from touchcell.cell.ui.access import Access
from touchcell.control.interlocks.config import build_interlocks, parse_interlocks
from touchcell.control.interlocks.planning_scene import PlanningScene
from touchcell.control.interlocks.snapshot import ArmView, CellView, SensorView
from touchcell.control.interlocks.timers import TimedInterlock
from touchcell.control.latch import Latch
from touchcell.control.supervisor import Supervisor
from touchcell.drivers.core.commands import TwistCommand, TwistFrame
from touchcell.drivers.core.errors import CommandRejected
from touchcell.drivers.core.samples import Stamped, TcpState
from touchcell.drivers.ur.driver import UrArm
from touchcell.errors import ConfigError, TouchcellError
from touchcell.geometry import se3
from touchcell.paths import CHECKOUT, CONFIGS
from touchcell.simulation import _paint


@dataclass(frozen=True, slots=True)
class Now:
    """What a reproduction gives now, and whether that is as it should be."""

    text: str
    fixed: bool


@dataclass(frozen=True, slots=True)
class Row:
    """One finding.

    Attributes:
        name: S1 to S7, R1 to R8, a1 to a13; those with a letter behind are parts of one finding.
        title: what was found.
        before: what 0.1.0 did.
        reproduce: gives what happens now, in an empty folder.
    """

    name: str
    title: str
    before: str
    reproduce: Callable[[Path], Now]


def _shipped(cell: str = cells_of.FOLLOW) -> dict[str, Any]:
    data: dict[str, Any] = yaml.safe_load((CONFIGS / f"{cell}.yaml").read_text())
    return data


def _true_contact(data: dict[str, Any]) -> dict[str, Any]:
    put_on_true_contact(data)
    return data


def _file(folder: Path, data: Mapping[str, Any] | str | bytes, name: str = "cell.yaml") -> Path:
    path = folder / name
    content = data if isinstance(data, str | bytes) else yaml.safe_dump(dict(data), sort_keys=False)
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def _check(folder: Path, data: Mapping[str, Any] | str | bytes) -> str:
    """What `check` says of a cell: "" if it is valid, else the first problem without the file's name."""
    path = _file(folder, data)
    try:
        plan_cell(path)
    except ConfigError as error:
        return str(error).splitlines()[0].replace(str(path), "cell.yaml")
    return ""


def _cli(*arguments: object, folder: Path, shell: str = "", timeout_s: float = 600.0) -> tuple[int, str]:
    """Exit code and output of ``touchcell`` in a process of its own."""
    command = [sys.executable, "-m", "touchcell", *map(str, arguments)]
    environment = {**os.environ, "PYTHONPATH": str(CHECKOUT)}
    if shell:
        command = ["bash", "-c", shell, "bash", *command]
    done = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, timeout=timeout_s, check=False, stdin=-3
    )
    return done.returncode, done.stdout + done.stderr


def _quiet(*arguments: object) -> tuple[int, str]:
    """Exit code and output of ``touchcell`` in this process."""
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(out):
        code = main([str(each) for each in arguments])
    return code, out.getvalue()


def _refused(folder: Path, cells: Mapping[str, Mapping[str, Any] | str | bytes]) -> Now:
    answers = {name: _check(folder, data) for name, data in cells.items()}
    accepted = [name for name, answer in answers.items() if not answer]
    text = f"{len(answers) - len(accepted)} of {len(answers)} refused"
    return Now(text + (f"; accepted: {', '.join(accepted)}" if accepted else ""), not accepted)


# Safety


def s1(folder: Path) -> Now:
    """Every moved arm needs bounds of its own, within reason."""
    return _refused(folder, cells_of.unbounded(_shipped))


def s2(folder: Path) -> Now:
    """Interlocks that can never trip."""
    return _refused(folder, cells_of.inactive(_shipped))


def s3(folder: Path) -> Now:
    """A depth limit beyond what the network was taught."""
    (data,) = cells_of.too_deep(_shipped).values()
    answer = _check(folder, data)
    return Now(f"check: {answer}" if answer else "accepted", bool(answer))


def s4(folder: Path) -> Now:
    """What a gate has sent belongs to the gate."""
    run = OperatedRun(folder)
    run.until("run")
    sent = run.loop._sent["arm"] if run.loop._sent else None
    assert sent is not None
    try:
        sent.command.twist[:] = np.nan
        text, fixed = "a caller can write NaN into it", False
    except ValueError as error:
        text, fixed = f"ValueError: {error}", True
    run.end()
    return Now(text, fixed)


def s5(folder: Path) -> Now:
    """A command without a lease."""
    run = OperatedRun(folder)
    command = TwistCommand(np.array([0.005, 0, 0, 0, 0, 0]), TwistFrame.BASE, run.cell.clock.now_ns(), 0.1)
    try:
        run.arm.send_twist(command, None)  # type: ignore[arg-type]
        now = Now("sent; the arm moves", False)
    except TouchcellError as error:
        now = Now(f"{type(error).__name__}: {error.message}", True)
    run.end()
    return now


def s6(folder: Path) -> Now:
    """A limit that two sensors exceed by turns."""
    settings = parse_interlocks({"deep": {"kind": "depth", "limit_mm": 4, "severity": "limit"}})
    supervisor = Supervisor(build_interlocks(settings, {"a": np.eye(4), "b": np.eye(4)}), Latch())
    for k in range(300):
        now_ns = (k + 1) * 10_000_000
        deeper, other = ("a", "b") if k % 2 else ("b", "a")
        seen = {deeper: SensorView(now_ns, k, True, 0.0061), other: SensorView(now_ns, k, True, 0.006)}
        supervisor.review(CellView(now_ns, {}, seen, "run"), ())
        if supervisor.latch.first_cause is not None:
            return Now(f"trips after {10 * (k + 1)} ms", True)
    return Now("no trip in 3 s", False)


def s6_flicker(folder: Path) -> Now:
    """A limit that is exceeded in 28 of 29 cycles, and one that is left by a hair."""
    settings = parse_interlocks({"deep": {"kind": "depth", "limit_mm": 4, "severity": "limit"}})
    supervisor = Supervisor(build_interlocks(settings, {"a": np.eye(4)}), Latch())
    tripped_ms = 0

    def seen(k: int, depth_m: float) -> CellView:
        return CellView((k + 1) * 10_000_000, {}, {"a": SensorView((k + 1) * 10_000_000, k, True, depth_m)}, "run")

    for k in range(1000):
        supervisor.review(seen(k, 0.003 if k % 29 == 28 else 0.0045), ())
        if supervisor.latch.first_cause is not None:
            tripped_ms = 10 * (k + 1)
            break
    settings = parse_interlocks({"deep": {"kind": "depth", "limit_mm": 4}})
    latch = Latch()
    supervisor = Supervisor(build_interlocks(settings, {"a": np.eye(4)}), latch)
    supervisor.review(seen(0, 0.0041), ())
    supervisor.review(seen(1, 0.00399), ())
    state = latch.state.value
    flicker = f"trips after {tripped_ms} ms" if tripped_ms else "no trip in 10 s"
    return Now(f"28 of 29 cycles: {flicker}; 4.1 to 3.99 mm: {state}", bool(tripped_ms) and state == "tripped")


def s7(folder: Path) -> Now:
    """One driver's exception, and the other arm."""
    from touchcell.cell.runtime.compose import compose
    from touchcell.cell.runtime.loop import RunLoop

    stop = StopRequest()
    path = _file(folder, _true_contact(_shipped(cells_of.PUSH)))
    with contextlib.ExitStack() as stack:
        cell = compose(plan_cell(path))
        stack.enter_context(contextlib.suppress(Exception))
        stack.enter_context(cell)
        loop = RunLoop(cell, None, stop=stop)
        loop.begin()
        for _ in range(100):
            loop.step()
        honest, told = cell.arms["leader"]._begin_stop, []

        def broken(*_: Any) -> None:
            raise OSError(32, "Broken pipe")

        follower_stop = cell.arms["follower"]._begin_stop
        cell.arms["leader"]._begin_stop = broken

        def noted(*rest: Any) -> Any:
            told.append(True)
            return follower_stop(*rest)

        cell.arms["follower"]._begin_stop = noted
        stop.ask_at_once()
        try:
            while loop.step():
                pass
            result = loop.end()
            text, fixed = f"follower stopped, run ends: {result.outcome.value}", bool(told)
        except OSError as error:
            text, fixed = f"the loop raises {error!r}; follower {'stopped' if told else 'not told'}", False
        cell.arms["leader"]._begin_stop = honest
    return Now(text, fixed)


# Reliability and evidence


def r1(folder: Path) -> Now:
    """A second run into the folder of the first."""
    path, out = _file(folder, _true_contact(_shipped())), folder / "o"
    _quiet("run", path, "--out", out, "--quiet")
    before = hashlib.md5((out / "run.mcap").read_bytes(), usedforsecurity=False).hexdigest()
    code, told = _quiet("run", path, "--out", out, "--quiet")
    same = before == hashlib.md5((out / "run.mcap").read_bytes(), usedforsecurity=False).hexdigest()
    return Now(f"exit {code}, first run {'untouched' if same else 'REPLACED'}: {_first(told)}", same and code == 2)


def _tripping(folder: Path) -> Path:
    return _file(folder, cells_of.tripping(_shipped), "trip.yaml")


def r1_busy(folder: Path) -> Now:
    """A run into the folder of another that goes on."""
    out = folder / "o"
    first = _file(folder, _shipped())
    command = [sys.executable, "-m", "touchcell", "run", str(first), "--out", str(out), "--quiet"]
    environment = {**os.environ, "PYTHONPATH": str(CHECKOUT)}
    going = subprocess.Popen(command, cwd=folder, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        while not (out / "cell.yaml").exists() and going.poll() is None:
            pass
        other = _file(folder, _true_contact(_shipped()) | {"name": "other"}, "other.yaml")
        code, told = _quiet("run", other, "--out", out, "--quiet")
        kept = (out / "cell.yaml").read_bytes() == first.read_bytes()
    finally:
        going.kill()
        going.wait()
    text = f"exit {code}; cell.yaml of the first {'untouched' if kept else 'REPLACED'}: {_first(told)}"
    return Now(text, kept and code == 2)


def r2(folder: Path) -> Now:
    """The exit code of a trip through a closed pipe."""
    _, told = _cli(
        "run", _tripping(folder), "--quiet", folder=folder, shell='"$@" | true; echo "code ${PIPESTATUS[0]}"'
    )
    code = told.split("code ")[-1].split()[0]
    _, full = _cli("run", folder / "trip.yaml", "--quiet", folder=folder, shell='"$@" >/dev/full; echo "code $?"')
    codes = (code, full.split("code ")[-1].split()[0])
    return Now(f"| true: {codes[0]}; >/dev/full: {codes[1]}", codes == ("3", "3") and "Traceback" not in full)


def r3(folder: Path) -> Now:
    """Key r of a user without a passwd entry."""
    import pty

    def nobody() -> str:
        raise KeyError("getpwuid(): uid not found: 12345")

    honest, getpass.getuser = getpass.getuser, nobody
    pid, fd = pty.fork()
    if pid == 0:
        code = 1
        with contextlib.suppress(BaseException), stop_on_keys(StopRequest(), channel=OperatorChannel()) as look:
            os.write(1, b".")
            sys.stdin.read(0)
            import select

            select.select([0], [], [], 10.0)
            look()
            code = 0
        os._exit(code)
    try:
        os.read(fd, 16)
        os.write(fd, b"r")
        status = os.waitpid(pid, 0)[1]
    finally:
        getpass.getuser = honest
        os.close(fd)
    return Now("key is taken" if status == 0 else "KeyError ends the run", status == 0)


def r4(folder: Path) -> Now:
    """The black box after kill -9, SIGSEGV and a full disk."""
    path, texts = _file(folder, _true_contact(_shipped())), []
    for name in ("SIGKILL", "SIGSEGV"):
        out = folder / name
        command = [sys.executable, "-m", "tests.helpers.dying_run", "900", name, str(path), str(out)]
        subprocess.run(command, cwd=CHECKOUT, capture_output=True, check=False, timeout=120)
        texts.append(f"{name}: {len(read_left_ring(out)[1])} of 900 messages")
    code, told = _quiet("why", folder / "SIGSEGV")
    return Now("; ".join(texts) + f"; why: exit {code}", code == 0 and "Segmentation fault" in told)


def r5(folder: Path) -> Now:
    """Requests that are no requests."""
    answers = []
    for name, content in {
        "Infinity": '{"ask": "reset", "operator": "x", "number": Infinity}',
        "nested": "[" * 200_000,
    }.items():
        channel = OperatorChannel(folder)
        channel.open()
        (folder / "request.json").write_text(content)
        try:
            channel.take()
            answers.append(f"{name}: ignored")
        except Exception as error:
            answers.append(f"{name}: {type(error).__name__}")
        channel.close()
    return Now("; ".join(answers), all(each.endswith("ignored") for each in answers))


def r6(folder: Path) -> Now:
    """Damaged recordings."""
    tried = list(fuzz_recordings.try_mutants(200, 5, folder))
    wrong = sum(bool(each.problem) for each in tried)
    path = _file(folder, fuzz_recordings.lz4_bomb(250), "bomb.mcap")
    damage: list[Damage] = []
    list(read(path, damage))
    return Now(f"200 mutants: {wrong} wrong answers; bomb: {damage[0].reason}", wrong == 0)


def r7(folder: Path) -> Now:
    """A loop that hangs for 0.5 s."""
    run = OperatedRun(folder, waiting_cell(on_trip="end"), operated=False)
    run.until("run")
    run.cell.clock.sleep_until_ns(run.cell.clock.now_ns() + 500_000_000)
    run.go(2000)
    result = run.end()
    return Now(f"{result.outcome.value}: {result.reason or '-'}", result.outcome.value == "tripped")


def r8(folder: Path) -> Now:
    """YAML fuzz; the first command from rest."""
    tried = list(fuzz_cells.try_mutants(300, 8))
    wrong = sum(each.verdict not in ("valid", "refused") for each in tried)
    run = OperatedRun(folder)
    lease = run.arm.acquire("findings")
    command = TwistCommand(np.array([0.09, 0, 0, 0, 0, 0]), TwistFrame.BASE, run.cell.clock.now_ns(), 1.0)
    sent = run.arm.send_twist(command, lease)
    speed = float(np.linalg.norm(sent.command.twist[:3]))
    run.arm.release(lease)
    run.end()
    text = (
        f"300 mutated cells: {wrong} tracebacks; first command from rest with ttl 1 s: {1e3 * speed:.1f} mm/s at once"
    )
    return Now(text, wrong == 0 and speed < 0.02)


def r8_arrays(folder: Path) -> Now:
    """Twists that are no arrays of six float64."""
    run = OperatedRun(folder)
    lease = run.arm.acquire("findings")
    answers = []
    for kind, twist in cells_of.odd_twists().items():
        try:
            command = TwistCommand(twist, TwistFrame.BASE, run.cell.clock.now_ns(), 0.1)
            run.arm.send_twist(command, lease)
            answers.append((kind, "sent"))
        except CommandRejected:
            answers.append((kind, "CommandRejected"))
        except Exception as error:
            answers.append((kind, type(error).__name__))
    run.arm.release(lease)
    run.end()
    wrong = [f"{kind}: {answer}" for kind, answer in answers if answer not in ("sent", "CommandRejected")]
    text = f"{len(answers) - len(wrong)} of {len(answers)} kinds are sent or CommandRejected"
    return Now(text + (f"; {', '.join(wrong)}" if wrong else ""), not wrong)


def r8_back(folder: Path) -> Now:
    """Ways back into the box that are none, 10 m outside."""
    entry = {"kind": "workspace", "arm": "arm", "min_mm": [-100] * 3, "max_mm": [100] * 3, "margin_mm": 10}
    passed = []
    for name, command, measured in cells_of.ways_back():
        (rule,) = build_interlocks(parse_interlocks({"it": entry}), {})
        assert isinstance(rule, TimedInterlock)
        arm = ArmView(
            Stamped(TcpState(se3.from_euler_mm_deg(np.array([1e4, 0, 0, 0, 0, 0.0])), np.array(measured)), 1, 1),
            TwistCommand(np.array(command), TwistFrame.BASE, 1, 0.03),
        )
        violation, _ = rule.evaluate(CellView(1, {"arm": arm}, {}, "run"), {})
        passed += [] if violation else [name]
    return Now(f"pass as a way back: {', '.join(passed) or 'none'}", not passed)


def r8_missing(folder: Path) -> Now:
    """A sensor and an arm that are missing from the view."""
    settings = parse_interlocks(
        {"frames": {"kind": "frame_age", "limit_ms": 100}, "states": {"kind": "arm_state_age", "limit_ms": 100}}
    )
    rules = build_interlocks(settings, {"sensor": np.eye(4)}, PlanningScene({"arm": np.eye(4)}))
    violated = [
        name
        for name, rule in zip(settings, rules, strict=True)
        if not isinstance(rule, TimedInterlock) and rule.check(CellView(10**9, {}, {}, "run")) is not None
    ]
    return Now(f"said by: {', '.join(violated) or 'no rule'}", len(violated) == 2)


def r8_page(folder: Path) -> Now:
    """A request to the operator's page under another host's name: DNS rebinding."""
    answered: list[int] = []

    async def send(message: Any) -> None:
        answered.extend([message["status"]] if message["type"] == "http.response.start" else [])

    async def page(scope: Any, receive: Any, send: Any) -> None:
        answered.append(200)

    async def receive() -> Any:
        return {"type": "http.request"}

    headers = [(b"host", b"evil.example:8177")]
    scope = {"type": "http", "method": "GET", "path": "/", "query_string": b"", "headers": headers}
    asyncio.run(Access(page, token="t", hosts=frozenset({"127.0.0.1:8177"}))(scope, receive, send))
    return Now(f"answers {answered[0]}", answered[0] == 421)


def r8_paint(folder: Path) -> Now:
    """Stamps of no size, and a window far outside, in C."""
    image, noise = np.zeros((60, 80), np.uint8), np.zeros((64, 90), np.int8)
    calls: dict[str, Callable[[], object]] = {
        "stamps (0, 0, s, s)": lambda: _paint.paint(image, np.zeros((1, 2)), np.zeros((0, 0, 5, 5), np.uint8)),
        "top 2**63 - 1": lambda: _paint.expose(image, image, image, noise, 2**63 - 1, 0),
    }
    refused = []
    for name, call in calls.items():
        with contextlib.suppress(TypeError, ValueError):
            call()
            continue
        refused.append(name)
    return Now(f"refused: {', '.join(refused) or 'none'}", len(refused) == 2)


# Use


def a1(folder: Path) -> Now:
    """Torch missing; the reason of a failed run."""
    program = "import sys; sys.modules['torch'] = None; from touchcell.cell.cli.main import main; sys.exit(main())"
    command = [sys.executable, "-c", program, "train", "--data", str(folder), "--out", str(folder / "m.safetensors")]
    told = subprocess.run(command, cwd=CHECKOUT, capture_output=True, text=True, check=False, timeout=120).stderr
    data = cells_of.over_nothing(_shipped)
    _quiet("run", _file(folder, data), "--out", folder / "o", "--quiet")
    reason = json.loads((folder / "o" / "result.json").read_text())["reason"]
    _, why = _quiet("why", folder / "o")
    recipe = next(CHECKOUT.glob("docs/**/recipe.md"), None)
    few = recipe is not None and "samples: 120" in recipe.read_text()
    explained = "none within 50 mm" in why and "none within 50 mm" in reason
    text = f"torch: {_first(told)}; result.json: {reason!r}; why explains: {'none within' in why}"
    return Now(
        text + ("; the recipe still takes samples: 120" if few else ""), explained and "train" in told and not few
    )


def a2(folder: Path) -> Now:
    """The pose that `probe` prints, and the one that the run uses."""
    from touchcell.cell.cli.devices import probe_cell
    from touchcell.drivers.core.clock import MonotonicClock
    from touchcell.drivers.ur import rig as ur

    rig = ur.rig(folder, _ADDRESS)
    assert rig.start is not None
    emulator = rig.start()
    try:
        data = _shipped()
        data["time"] = "real"
        data["arms"]["arm"] = {"driver": "ur", "deactivate": "hold", **ur.config_of(_ADDRESS).model_dump(mode="json")}
        data["sensors"]["sensor"] = {
            "driver": "v4l2",
            "device": "/dev/none",
            "mounted_on": "arm",
            "estimator": {"kind": "network", "model": "builtin:sim_gdn"},
        }
        del data["scene"], data["interlocks"]["inconsistent"]
        pose = dict(probe_cell(_file(folder, data))[0].readings)["tool at"]
        arm = rig.build(MonotonicClock())
        assert isinstance(arm, UrArm)
        with arm:
            arm.configure()
            arm.activate()
            run_mm = se3.to_euler_mm_deg(arm.tcp().value.T_base_tcp)[:3]
    finally:
        emulator.stop()
    off_mm = float(np.linalg.norm(np.array(json.loads(pose.partition("]")[0] + "]"))[:3] - run_mm))
    return Now(f"probe and run are {off_mm:.1f} mm apart", off_mm < 0.1)


def a3(folder: Path) -> Now:
    """What the wheel installs."""
    import tomllib

    settings = tomllib.loads((CHECKOUT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"]["find"]
    found = {name.partition(".")[0] for name in settings["include"]}
    return Now(f"top level of the wheel: {', '.join(sorted(found))}", found == {"touchcell"})


def a4(folder: Path) -> Now:
    """Names that leave the folder of runs."""
    return _refused(folder, cells_of.badly_named(_shipped))


def a5(folder: Path) -> Now:
    """Models that are not there."""
    answers = [_check(folder, data) for data in cells_of.without_model(_shipped).values()]
    wanted = ("sim_gdn", "train --data DIR --out", "is no file", "cell.yaml")
    fixed = all(words in answer for words, answer in zip(wanted, answers, strict=True))
    return Now("; ".join(answer.partition("model: ")[2][:60] for answer in answers), fixed)


def a6(folder: Path) -> Now:
    """The example of the safety page, pasted into the shipped cell."""
    page = next(CHECKOUT.glob("docs/**/safety.md")).read_text()
    data = cells_of.safety_example(_shipped, page)
    if answer := _check(folder, data):
        return Now(f"check: {answer}", False)
    code, told = _quiet("run", folder / "cell.yaml", "--out", folder / "o", "--quiet")
    return Now(_first(told), code == 0)


def a7(folder: Path) -> Now:
    """Tracebacks."""
    commands = cells_of.broken_commands(folder, _file(folder, _shipped(), "good.yaml"))
    traced = []
    for name, command in commands.items():
        code, told = _cli(*command, folder=folder)
        if "Traceback" in told or code in (0, 1):
            traced.append(f"{name} ({code})")
    text = f"{len(commands) - len(traced)} of {len(commands)} are one message"
    return Now(text + (f"; not: {', '.join(traced)}" if traced else ""), not traced)


def a8(folder: Path) -> Now:
    """What `check` accepted and `run` refused or tripped on."""
    return _refused(folder, cells_of.doomed(_shipped))


def a9(folder: Path) -> Now:
    """Messages with a wrong remedy."""
    wanted = cells_of.badly_answered(_shipped, (CONFIGS / f"{cells_of.FOLLOW}.yaml").read_text())
    wrong = [answer for data, words in wanted if words not in (answer := _check(folder, data))]
    return Now(f"{len(wanted) - len(wrong)} of {len(wanted)} right" + "".join(f"; {each}" for each in wrong), not wrong)


def a10(folder: Path) -> Now:
    """The age of a pose that an arm accepts."""
    import inspect

    from touchcell.drivers.franka import driver as franka
    from touchcell.drivers.ur import driver as ur
    from touchcell.simulation.devices import arm as sim

    passed = {module.__name__.split(".")[2]: "max_state_age_s=" in inspect.getsource(module) for module in (ur, franka)}
    passed["sim_arm"] = "max_state_age_s=" in inspect.getsource(sim)
    fixed_at = [name for name, given in passed.items() if not given]
    return Now(f"fixed at 0.1 s in: {', '.join(fixed_at)}" if fixed_at else "each driver passes its own", not fixed_at)


def a11(folder: Path) -> Now:
    """The exit code of a failed run through a pipe."""
    data = cells_of.over_nothing(_shipped)
    _, told = _cli(
        "run", _file(folder, data), "--quiet", folder=folder, shell='"$@" | true; echo "code ${PIPESTATUS[0]}"'
    )
    code = told.split("code ")[-1].split()[0]
    return Now(f"exit {code}", code == "1")


def a12(folder: Path) -> Now:
    """Warnings on the user's terminal."""
    data = cells_of.over_nothing(_shipped)
    _, failed = _cli("run", _file(folder, data), "--quiet", folder=folder)
    _, tripped = _cli("run", _tripping(folder), "--quiet", folder=folder)
    warned = [line for line in (failed + tripped).splitlines() if "Warning" in line]
    return Now(warned[0] if warned else "none", not warned)


def a13(folder: Path) -> Now:
    """A data set that nothing reads."""
    code, told = _quiet("run", _file(folder, _shipped()), "--data", "/nonexist", "--out", folder / "o")
    return Now(f"exit {code}: {_first(told).partition('cell.yaml:1: ')[2]}", code == 2)


def _first(told: str) -> str:
    return next((line for line in told.splitlines() if line.strip()), "")


ROWS = (
    Row("S1", "a moved arm without bounds of its own", "all 7 cells accepted; follower ran 225 mm out", s1),
    Row("S2", "interlocks that can never trip", "all accepted without a word", s2),
    Row("S3", "depth limit beyond the network's range", "9 mm accepted, taught to 7.3 mm; trips at 11.3 mm true", s3),
    Row("S4", "gate state shared with callers", "NaN written into it reached the arm", s4),
    Row("S5", "lease=None while nobody holds one", "sent; the arm moved 5 mm/s", s5),
    Row("S6", "LIMIT whose worst subject alternates", "no trip in 3 s", s6),
    Row("S6b", "LIMIT that flickers; no hysteresis", "28 of 29 cycles: no trip; cause gone at once", s6_flicker),
    Row("S7", "one driver's OSError at a stop", "step() raised; the other arm was told late", s7),
    Row("R1", "a second run into one folder", "exit 0, recording replaced", r1),
    Row("R1b", "a run into the folder of one that goes on", "refused after cell.yaml was replaced", r1_busy),
    Row("R2", "exit code of a trip in a pipe", "| true: 0; >/dev/full: 1 with a traceback", r2),
    Row("R3", "key r without a passwd entry", "KeyError, no result, no black box", r3),
    Row("R4", "black box after kill -9, SIGSEGV", "none in one process", r4),
    Row("R5", "request.json that is no request", "OverflowError, RecursionError end the run", r5),
    Row("R6", "damaged recordings", "547 of 2072 tracebacks, changed values read; bomb 348 s", r6),
    Row("R7", "a loop that hangs 0.5 s", "done, no violation", r7),
    Row("R8", "YAML fuzz; first command from rest", "2341 of 9475 tracebacks; 0 to 100 mm/s at once", r8),
    Row("R8b", "twists that are no six float64", "others than CommandRejected are raised", r8_arrays),
    Row("R8c", "a way back that is none", "-1e-9 m/s, 5 m/s sideways, measured outwards: all pass", r8_back),
    Row("R8d", "a role that is missing from the view", "frame_age and arm_state_age say nothing", r8_missing),
    Row("R8e", "the page under another host's name", "no Host check", r8_page),
    Row("R8f", "C: stamps of no size, a window far outside", "read outside their arrays (ASAN)", r8_paint),
    Row("a1", "recipe; torch missing; reason of a failure", "12-line traceback; reason ''; why: no black box", a1),
    Row("a2", "probe's pose is not the run's", "100 mm off, not told", a2),
    Row("a3", "generic top-level packages", "benchmarks cell configs control drivers geometry ...", a3),
    Row("a4", "names that leave runs/", "all accepted; folder made two levels up", a4),
    Row("a5", "models that are not there", "wrong syntax in the remedy; no list; 'no such file'", a5),
    Row("a6", "the safety page's example", "clearance trips at t = 0", a6),
    Row("a7", "tracebacks instead of messages", "all with tracebacks, the bomb hung > 60 s", a7),
    Row("a8", "check says valid, run refuses or trips", "all 14 accepted", a8),
    Row("a9", "messages without the right remedy", "0 of 8", a9),
    Row("a10", "pose age fixed at 0.1 s", "UR, Franka and simulated arms", a10),
    Row("a11", "exit code of a failed run in a pipe", "exit 0", a11),
    Row("a12", "warnings on the terminal", "UserWarning identical xlims, Mean of empty slice", a12),
    Row("a13", "--data that nothing reads", "silently ignored", a13),
)


def reproduced(row: Row) -> tuple[str, str]:
    """Verdict and text of one row now."""
    with tempfile.TemporaryDirectory() as folder:
        before = Path.cwd()
        os.chdir(folder)
        logging.disable()
        try:
            now = row.reproduce(Path(folder))
        except Exception as error:
            return "OPEN", f"{type(error).__name__}: {_first(str(error))}"
        finally:
            logging.disable(logging.NOTSET)
            os.chdir(before)
    return ("fixed" if now.fixed else "OPEN"), now.text


def reproduced_then(row: Row, checkout: Path) -> str:
    """What the version in ``checkout`` gives, in a process with its own interpreter and packages."""
    script = CHECKOUT / "tests" / "earlier" / "findings_0_1_0.py"
    python = checkout.absolute() / ".venv" / "bin" / "python"
    with tempfile.TemporaryDirectory() as folder:
        if row.name == "R8":
            fuzz_cells.write_mutants(Path(folder) / "mutants", 300, 8, checkout / "configs")
        environment = {**os.environ, "PYTHONPATH": f"{checkout.absolute()}{os.pathsep}{Path(__file__).parent}"}
        done = subprocess.run(
            [str(python), str(script), row.name],
            cwd=folder,
            env=environment,
            capture_output=True,
            text=True,
            check=False,
            timeout=600,
        )
    return done.stdout.strip() or f"no answer: {done.stderr.strip().splitlines()[-1:]}"


def run(arguments: Sequence[str], out: Path) -> None:
    """Print the table of all rows, or of those named; write ``findings.json`` into ``out``."""
    parser = argparse.ArgumentParser(prog="findings", description=__doc__)
    parser.add_argument("--against", type=Path, metavar="CHECKOUT", help="of 0.1.0, with a .venv of its own")
    parser.add_argument("rows", nargs="*", metavar="ROW")
    options = parser.parse_args(arguments)
    rows = [row for row in ROWS if not options.rows or row.name in options.rows]
    found = {}
    for row in rows:
        verdict, text = reproduced(row)
        then = reproduced_then(row, options.against) if options.against else ""
        found[row.name] = {
            "title": row.title,
            "recorded": row.before,
            "then": then,
            "now": text,
            "verdict": verdict,
        }
        print(f"{row.name:<4} {verdict:<6} {row.title}")
        for label, words in (("0.1.0", then or f"{row.before} (recorded)"), ("now", text)):
            print(
                textwrap.fill(words, 116, initial_indent=f"       {label:<6} ", subsequent_indent=" " * 14), flush=True
            )
    counts = {verdict: sum(each["verdict"] == verdict for each in found.values()) for verdict in ("fixed", "OPEN")}
    print(", ".join(f"{count} {verdict}" for verdict, count in counts.items()))
    (out / "findings.json").write_text(json.dumps({**provenance(), "rows": found}, indent=1) + "\n")


_ADDRESS = 43
