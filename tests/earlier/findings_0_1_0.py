"""What touchcell 0.1.0 answers to the reproductions of ``findings``.

``python findings_0_1_0.py ROW`` runs with the interpreter of a checkout of 0.1.0, its root and
``tests/fault_injection`` as PYTHONPATH, in an empty folder, and prints one line. It knows the flat packages of that
version, so that nothing here is type-checked.
"""
# ruff: noqa: TID251, I001

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import os
import random
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

import cell
import findings_cells as cells_of
import numpy as np
import yaml
from cell.cli import main
from cell.config import plan_cell
from control.interlocks import build_interlocks, parse_interlocks
from control.latch import Latch
from control.supervisor import Supervisor
from control.view import CellView, SensorView
from drivers.clock import VirtualClock
from drivers.commands import TwistCommand, TwistFrame
from drivers.device import Lifecycle
from drivers.gate import TwistGate, TwistLimits
from drivers.lease import LeaseDesk
from geometry.errors import TouchcellError

CHECKOUT = Path(cell.__file__).parent.parent
CONFIGS = CHECKOUT / "configs"
HERE = Path.cwd()


def shipped(name: str) -> dict[str, Any]:
    return yaml.safe_load((CONFIGS / f"{name}.yaml").read_text())


def write(data: Any, name: str = "cell.yaml") -> Path:
    path = HERE / name
    content = data if isinstance(data, str | bytes) else yaml.safe_dump(dict(data), sort_keys=False)
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def check(data: Any) -> str:
    """What `check` prints, with the type of what is raised by mistake; "" if the cell is valid."""
    path = write(data)
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(out):
        try:
            code = main(["check", str(path)])
        except Exception as error:
            return f"{type(error).__name__}: {error}"
    return out.getvalue().replace(str(path), "cell.yaml") if code else ""


def answers(cells: dict[str, Any]) -> str:
    accepted = [name for name, data in cells.items() if not check(data)]
    return f"{len(accepted)} of {len(cells)} accepted: {', '.join(accepted)}"


def cli(*arguments: object, shell: str = "", timeout_s: float = 600.0) -> tuple[int, str]:
    command = [sys.executable, "-c", "import sys; from cell.cli import main; sys.exit(main())", *map(str, arguments)]
    if shell:
        command = ["bash", "-c", shell, "bash", *command]
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=timeout_s, check=False, stdin=subprocess.DEVNULL
        )
    except subprocess.TimeoutExpired:
        return 124, "hangs"
    return done.returncode, done.stdout + done.stderr


def first(text: str) -> str:
    return next((line for line in text.splitlines() if line.strip()), "")


class Gate:
    """A gate at 100 Hz whose commands are 0.09 m/s."""

    def __init__(self) -> None:
        self.clock = VirtualClock(10**9)
        self.desk = LeaseDesk("arm")
        self.gate = TwistGate("arm", TwistLimits(0.1, 0.5, 0.5, 2.5, 20.0, 100.0), self.desk, self.clock)

    def send(self, lease: Any, ttl_s: float = 0.1, speed: float = 0.09) -> Any:
        self.clock.advance_s(0.01)
        twist = np.array([speed, 0, 0, 0, 0, 0])
        command = TwistCommand(twist, TwistFrame.BASE, self.clock.now_ns(), ttl_s)
        return self.gate.admit(command, lease, Lifecycle.ACTIVE, np.eye(4))


class Loop:
    """A run on true contact, cycle by cycle."""

    def __init__(self, data: dict[str, Any]) -> None:
        from cell.compose import compose
        from cell.loop import RunLoop, StopRequest

        self.stop = StopRequest()
        self.cell = compose(plan_cell(write(data)))
        self.cell.__enter__()
        self.loop = RunLoop(self.cell, None, stop=self.stop)
        self.loop.begin()

    def until(self, state: str) -> None:
        for _ in range(3000):
            if self.cell.task.state == state or not self.loop.step():
                return


def s4() -> str:
    gate = Gate()
    lease = gate.desk.acquire("findings")
    sent = gate.send(lease)
    sent.command.twist[:] = np.nan
    return f"NaN written into what was sent; the next command sent is {gate.send(lease).command.twist[:2]}"


def s5() -> str:
    return f"sent without a lease: {1e3 * Gate().send(None, speed=0.005).command.twist[0]:.1f} mm/s"


def s6() -> str:
    settings = parse_interlocks({"deep": {"kind": "depth", "limit_mm": 4, "severity": "limit"}})
    supervisor = Supervisor(build_interlocks(settings, {"a": np.eye(4), "b": np.eye(4)}), Latch())
    for k in range(300):
        now_ns = (k + 1) * 10_000_000
        deeper, other = ("a", "b") if k % 2 else ("b", "a")
        seen = {deeper: SensorView(now_ns, k, True, 0.0061), other: SensorView(now_ns, k, True, 0.006)}
        supervisor.review(CellView(now_ns, {}, seen, "run"), ())
        if supervisor.latch.first_cause is not None:
            return f"trips after {10 * (k + 1)} ms"
    return "no trip in 3 s"


def s6_flicker() -> str:
    def seen(k: int, depth_m: float) -> CellView:
        return CellView((k + 1) * 10_000_000, {}, {"a": SensorView((k + 1) * 10_000_000, k, True, depth_m)}, "run")

    settings = parse_interlocks({"deep": {"kind": "depth", "limit_mm": 4, "severity": "limit"}})
    supervisor, flicker = Supervisor(build_interlocks(settings, {"a": np.eye(4)}), Latch()), "no trip in 10 s"
    for k in range(1000):
        supervisor.review(seen(k, 0.003 if k % 29 == 28 else 0.0045), ())
        if supervisor.latch.first_cause is not None:
            flicker = f"trips after {10 * (k + 1)} ms"
            break
    settings, latch = parse_interlocks({"deep": {"kind": "depth", "limit_mm": 4}}), Latch()
    supervisor = Supervisor(build_interlocks(settings, {"a": np.eye(4)}), latch)
    supervisor.review(seen(0, 0.0041), ())
    supervisor.review(seen(1, 0.00399), ())
    return f"28 of 29 cycles: {flicker}; 4.1 to 3.99 mm: {latch.state.value}"


def s7() -> str:
    run = Loop(cells_of.on_true_contact(shipped(cells_of.PUSH)))
    for _ in range(100):
        run.loop.step()
    noted: list[bool] = []
    follower_stop = run.cell.arms["follower"]._begin_stop

    def broken(*_: Any) -> None:
        raise OSError(32, "Broken pipe")

    def note(*rest: Any) -> Any:
        noted.append(True)
        return follower_stop(*rest)

    run.cell.arms["leader"]._begin_stop = broken
    run.cell.arms["follower"]._begin_stop = note
    run.stop.ask_at_once()
    try:
        while run.loop.step():
            pass
        run.loop.end()
    except OSError as error:
        return f"the loop raises {error!r}; follower {'stopped' if noted else 'is not stopped'}"
    return f"run ends, follower {'stopped' if noted else 'is not stopped'}"


def r1() -> str:
    path, out = write(cells_of.on_true_contact(shipped(cells_of.FOLLOW))), HERE / "o"
    cli("run", path, "--out", out, "--quiet")
    before = hashlib.sha256((out / "run.mcap").read_bytes()).digest()
    code, _ = cli("run", path, "--out", out, "--quiet")
    same = hashlib.sha256((out / "run.mcap").read_bytes()).digest() == before
    return f"exit {code}, first run {'untouched' if same else 'REPLACED'}"


def r1_busy() -> str:
    first, out = write(shipped(cells_of.FOLLOW)), HERE / "o"
    program = "import sys; from cell.cli import main; sys.exit(main())"
    command = [sys.executable, "-c", program, "run", str(first), "--out", str(out), "--quiet"]
    going = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        while not (out / "run.mcap").exists() and going.poll() is None:
            pass
        other = write(cells_of.on_true_contact(shipped(cells_of.FOLLOW)) | {"name": "other"}, "other.yaml")
        code, _ = cli("run", other, "--out", out, "--quiet")
        kept = (out / "cell.yaml").read_bytes() == first.read_bytes()
    finally:
        going.kill()
        going.wait()
    return f"exit {code}; cell.yaml of the first {'untouched' if kept else 'REPLACED'}"


def r2() -> str:
    path = write(cells_of.tripping(shipped))
    _, piped = cli("run", path, "--quiet", shell='"$@" | true; echo "code ${PIPESTATUS[0]}"')
    _, full = cli("run", path, "--quiet", shell='"$@" >/dev/full; echo "code $?"')
    codes = [text.split("code ")[-1].split()[0] for text in (piped, full)]
    return f"| true: {codes[0]}; >/dev/full: {codes[1]}{', with a traceback' if 'Traceback' in full else ''}"


def r3() -> str:
    import getpass

    from cell import operator
    from cell.desk import OperatorDesk
    from cell.loop import StopRequest

    def no_entry() -> str:
        raise KeyError("getpwuid(): uid not found: 12345")

    getpass.getuser = no_entry
    out, into = os.pipe()
    os.write(into, b"r")
    try:
        operator._look(out, StopRequest(), OperatorDesk())
    except KeyError as error:
        return f"KeyError: {error}"
    return "key is taken"


def r4() -> str:
    from cell.blackbox import BlackBox

    path, found = write(cells_of.on_true_contact(shipped(cells_of.FOLLOW))), []
    for number in (signal.SIGKILL, signal.SIGSEGV):
        out = HERE / number.name
        pid = os.fork()
        if pid == 0:
            add, count = BlackBox.add, [0]

            def add_and_die(*rest: Any, add: Any = add, count: list[int] = count, number: int = number) -> None:
                add(*rest)
                count[0] += 1
                if count[0] == 900:
                    os.kill(os.getpid(), number)

            BlackBox.add = add_and_die
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
            main(["run", str(path), "--out", str(out), "--quiet"])
            os._exit(0)
        os.waitpid(pid, 0)
        boxes = [each.name for each in out.iterdir() if "box" in each.name and each.stat().st_size]
        found.append(f"{number.name}: {', '.join(boxes) or 'no black box'}")
    return "; ".join(found)


def r5() -> str:
    from cell.desk import OperatorDesk

    found = []
    for name, content in {
        "Infinity": '{"ask": "reset", "operator": "x", "number": Infinity}',
        "nested": "[" * 200_000,
    }.items():
        desk = OperatorDesk(HERE)
        desk.open()
        (HERE / "request.json").write_text(content)
        try:
            desk.take()
            found.append(f"{name}: ignored")
        except Exception as error:
            found.append(f"{name}: {type(error).__name__}")
        desk.close()
    return "; ".join(found)


def r6() -> str:
    from cell.errors import RecordingError
    from cell.recording import read

    path = write(cells_of.on_true_contact(shipped(cells_of.FOLLOW)))
    cli("run", path, "--out", HERE / "o", "--quiet")
    content = (HERE / "o" / "run.mcap").read_bytes()[:200_000]
    whole = [repr(each) for each in _read(read, content)[0]]
    chance, counts = random.Random(5), Counter[str]()
    for _ in range(200):
        damaged = bytearray(content)
        damaged[chance.randrange(len(damaged))] ^= 1 << chance.randrange(8)
        messages, error = _read(read, bytes(damaged))
        if error is not None and not isinstance(error, RecordingError):
            counts[f"traceback {type(error).__name__}"] += 1
        elif any(repr(each) != then for each, then in zip(messages, whole, strict=False)):
            counts["changed values read"] += 1
    return f"200 mutants: {', '.join(f'{n} {what}' for what, n in counts.most_common())}; the bomb is not tried"


def _read(read: Any, content: bytes) -> tuple[list[Any], Exception | None]:
    path, messages = write(content, "mutant.mcap"), []
    try:
        messages.extend(read(path))
    except Exception as error:
        return messages, error
    return messages, None


def r7() -> str:
    run = Loop(cells_of.on_true_contact(shipped(cells_of.FOLLOW)))
    run.until("run")
    clock = run.cell.clock
    clock.sleep_until_ns(clock.now_ns() + 500_000_000)
    for _ in range(3000):
        if not run.loop.step():
            break
    result = run.loop.end()
    return f"{result.outcome.value}: {result.reason or '-'}"


def r8() -> str:
    counts: Counter[str] = Counter()

    def hangs(*_: Any) -> None:
        raise TimeoutError

    signal.signal(signal.SIGALRM, hangs)
    mutants = sorted((HERE / "mutants").iterdir())
    for path in mutants:
        signal.alarm(10)
        try:
            plan_cell(path)
        except TimeoutError:
            counts["hang for 10 s"] += 1
        except Exception as error:
            if not isinstance(error, TouchcellError):
                counts[type(error).__name__] += 1
        signal.alarm(0)
    gate = Gate()
    speed = gate.send(gate.desk.acquire("findings"), ttl_s=1.0).command.twist[0]
    wrong = ", ".join(f"{n} {what}" for what, n in counts.most_common())
    return (
        f"{len(mutants)} mutated cells: {wrong}; first command from rest with ttl 1 s: {1e3 * speed:.1f} mm/s at once"
    )


def r8_arrays() -> str:
    from drivers.errors import CommandRejected

    gate = Gate()
    lease, wrong, kinds = gate.desk.acquire("findings"), [], cells_of.odd_twists()
    for kind, twist in kinds.items():
        gate.clock.advance_s(0.01)
        try:
            command = TwistCommand(twist, TwistFrame.BASE, gate.clock.now_ns(), 0.1)
            gate.gate.admit(command, lease, Lifecycle.ACTIVE, np.eye(4))
        except CommandRejected:
            continue
        except Exception as error:
            wrong.append(f"{kind}: {type(error).__name__}")
    return f"{len(kinds) - len(wrong)} of {len(kinds)} kinds are sent or CommandRejected; {', '.join(wrong)}"


def r8_back() -> str:
    from control.view import ArmView
    from drivers.samples import Stamped, TcpState

    entry = {"kind": "workspace", "arm": "arm", "min_mm": [-100] * 3, "max_mm": [100] * 3, "margin_mm": 10}
    passed = []
    for name, command, measured in cells_of.ways_back():
        (rule,) = build_interlocks(parse_interlocks({"it": entry}), {})
        T = np.eye(4)
        T[0, 3] = 10.0
        arm = ArmView(
            Stamped(TcpState(T, np.array(measured)), 1, 1), TwistCommand(np.array(command), TwistFrame.BASE, 1, 0.03)
        )
        passed += [] if rule.check(CellView(1, {"arm": arm}, {}, "run")) else [name]
    return f"pass as a way back: {', '.join(passed) or 'none'}"


def r8_missing() -> str:
    settings = parse_interlocks(
        {"frames": {"kind": "frame_age", "limit_ms": 100}, "states": {"kind": "arm_state_age", "limit_ms": 100}}
    )
    rules = build_interlocks(settings, {"sensor": np.eye(4)})
    violated = [n for n, rule in zip(settings, rules, strict=True) if rule.check(CellView(10**9, {}, {}, "run"))]
    return f"said by: {', '.join(violated) or 'no rule'}"


def r8_page() -> str:
    found = "Host" in (CHECKOUT / "cell" / "view.py").read_text()
    return "checks the host" if found else "no Host check in its server"


def r8_paint() -> str:
    from drivers.simulation import _paint

    image, noise, refused = np.zeros((60, 80), np.uint8), np.zeros((64, 90), np.int8), []
    for name, call in {
        "stamps (0, 0, s, s)": lambda: _paint.paint(image, np.zeros((1, 2)), np.zeros((0, 0, 5, 5), np.uint8)),
        "top 2**63 - 1": lambda: _paint.expose(image, image, image, noise, 2**63 - 1, 0),
    }.items():
        try:
            call()
        except (TypeError, ValueError):
            refused.append(name)
    return f"refused: {', '.join(refused) or 'none'}"


def a1() -> str:
    program = "import sys; sys.modules['torch'] = None; from cell.cli import main; sys.exit(main())"
    command = [sys.executable, "-c", program, "train", "--data", str(HERE), "--out", str(HERE / "m.safetensors")]
    answer = subprocess.run(command, capture_output=True, text=True, check=False).stderr
    cli("run", write(cells_of.over_nothing(shipped)), "--out", HERE / "o", "--quiet")
    reason = json.loads((HERE / "o" / "result.json").read_text()).get("reason")
    _, why = cli("why", HERE / "o")
    few = "samples: 120" in (CHECKOUT / "docs" / "recipe.md").read_text()
    return (
        f"torch: {len(answer.splitlines())} lines, last {answer.splitlines()[-1]}; result.json: {reason!r}; "
        f"why: {first(why)}{'; the recipe takes samples: 120' if few else ''}"
    )


def a2() -> str:
    from cell.devices import probe_cell
    from drivers.emulators.rigs import ur
    from geometry import se3

    rig = ur.rig(HERE, 41)
    emulator = rig.start()
    try:
        data = shipped(cells_of.FOLLOW)
        data["time"] = "real"
        data["arms"]["arm"] = {"driver": "ur", "deactivate": "hold", **ur.config_of(41).model_dump(mode="json")}
        data["sensors"]["sensor"] = {
            "driver": "v4l2",
            "device": "/dev/none",
            "mounted_on": "arm",
            "estimator": {"kind": "network", "model": "builtin:sim_gdn"},
        }
        del data["scene"]
        probe = probe_cell(write(data))[0]
        told = dict(probe.readings)["tool at"]
        arm = rig.build(__import__("drivers.clock", fromlist=["x"]).MonotonicClock())
        with arm:
            arm.configure()
            arm.activate()
            run_mm = se3.to_euler_mm_deg(arm.tcp().value.T_base_tcp)[:3]
    finally:
        emulator.stop()
    off_mm = float(np.linalg.norm(np.array(json.loads(told.partition("]")[0] + "]"))[:3] - run_mm))
    return f"probe and run are {off_mm:.1f} mm apart"


def a3() -> str:
    import tomllib

    settings = tomllib.loads((CHECKOUT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"]
    names = settings["find"]["include"] if isinstance(settings, dict) else settings
    return f"top level of the wheel: {', '.join(sorted({name.partition('.')[0].rstrip('*') for name in names}))}"


def a5() -> str:
    found = [check(data) or "accepted" for data in cells_of.without_model(shipped).values()]
    return "; ".join(first(each).partition("model: ")[2][:60] or first(each)[:60] for each in found)


def a6() -> str:
    data = cells_of.safety_example(shipped, (CHECKOUT / "docs" / "safety.md").read_text())
    refused = check(data)
    # As `check` demands.
    for key in ("body", "limits"):
        data["arms"]["follower"].setdefault(key, data["arms"]["leader"][key])
    told = first(cli("run", write(data), "--out", HERE / "o", "--quiet")[1])
    return f"{'refused without a body for the follower; with one: ' if refused else ''}{told}"


def a7() -> str:
    commands = cells_of.broken_commands(HERE, write(shipped(cells_of.FOLLOW), "good.yaml"))
    wrong = []
    for name, command in commands.items():
        code, text = cli(*command, timeout_s=20.0)
        if "Traceback" in text or code in (0, 1, 124):
            wrong.append(f"{name} ({'hangs' if code == 124 else 'traceback' if 'Traceback' in text else code})")
    return f"{len(commands) - len(wrong)} of {len(commands)} are one message; not: {', '.join(wrong)}"


def a9() -> str:
    pairs = cells_of.badly_answered(shipped, (CONFIGS / f"{cells_of.FOLLOW}.yaml").read_text())
    return f"{sum(words in check(data) for data, words in pairs)} of {len(pairs)} right"


def a10() -> str:
    fixed = [
        n for n in ("ur", "franka", "sim_arm") if "max_state_age_s=" not in (CHECKOUT / f"drivers/{n}.py").read_text()
    ]
    return f"fixed at 0.1 s in: {', '.join(fixed)}"


def a11() -> str:
    _, text = cli(
        "run", write(cells_of.over_nothing(shipped)), "--quiet", shell='"$@" | true; echo "code ${PIPESTATUS[0]}"'
    )
    return f"exit {text.split('code ')[-1].split()[0]}"


def a12() -> str:
    text = cli("run", write(cells_of.over_nothing(shipped)), "--quiet")[1]
    text += cli("run", write(cells_of.tripping(shipped)), "--quiet")[1]
    warned = [line.rpartition("/")[2] for line in text.splitlines() if "Warning:" in line]
    return "; ".join(dict.fromkeys(warned)) or "none"


def a13() -> str:
    code, _ = cli("run", write(cells_of.on_true_contact(shipped(cells_of.FOLLOW))), "--data", "/nonexist", "--quiet")
    return f"exit {code}, ignored"


ROWS = {
    "S1": lambda: answers(cells_of.unbounded(shipped)),
    "S2": lambda: answers(cells_of.inactive(shipped)),
    "S3": lambda: answers(cells_of.too_deep(shipped)),
    **{"S4": s4, "S5": s5, "S6": s6, "S7": s7},
    **{"S6b": s6_flicker, "R1b": r1_busy, "R8b": r8_arrays, "R8c": r8_back, "R8d": r8_missing},
    **{"R8e": r8_page, "R8f": r8_paint},
    **{"R1": r1, "R2": r2, "R3": r3, "R4": r4, "R5": r5, "R6": r6, "R7": r7, "R8": r8},
    **{"a1": a1, "a2": a2, "a3": a3},
    "a4": lambda: answers(cells_of.badly_named(shipped)),
    **{"a5": a5, "a6": a6, "a7": a7},
    "a8": lambda: answers(cells_of.doomed(shipped)),
    **{"a9": a9, "a10": a10, "a11": a11, "a12": a12, "a13": a13},
}

if __name__ == "__main__":
    started_s = time.monotonic()
    with contextlib.redirect_stdout(io.StringIO()):
        line = ROWS[sys.argv[1]]()
    print(line)
