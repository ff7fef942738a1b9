"""What an adversarial audit and a first user found in version 0.1.0, and what each reproduction gives now.

``python -m benchmarks findings [ROW ...]`` runs one small reproduction for each row and prints a table: what was found,
what 0.1.0 did (recorded then), what happens now. Rows S are of safety, R of reliability and evidence, a of use.
"""

from __future__ import annotations

import contextlib
import getpass
import gzip
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

from tests.fault_injection import fuzz_cells, fuzz_recordings
from tests.helpers.operated_run import OperatedRun, waiting_cell
from touchcell.cell.cli.main import main
from touchcell.cell.config.schema import plan_cell
from touchcell.cell.config.true_contact import put_on_true_contact
from touchcell.cell.recording.mcap import Damage, read
from touchcell.cell.runtime.black_box import read_left_ring
from touchcell.cell.runtime.operator_channel import OperatorChannel
from touchcell.cell.runtime.operator_input import stop_on_keys
from touchcell.cell.runtime.stop_request import StopRequest
from touchcell.control.interlocks.config import build_interlocks, parse_interlocks
from touchcell.control.interlocks.snapshot import CellView, SensorView
from touchcell.control.latch import Latch
from touchcell.control.supervisor import Supervisor
from touchcell.drivers.core.commands import TwistCommand, TwistFrame
from touchcell.errors import ConfigError, TouchcellError
from touchcell.paths import CHECKOUT, CONFIGS


@dataclass(frozen=True, slots=True)
class Now:
    """What a reproduction gives now, and whether that is as it should be."""

    text: str
    fixed: bool


@dataclass(frozen=True, slots=True)
class Row:
    """One finding.

    Attributes:
        name: S1 to S7, R1 to R8, a1 to a13.
        title: what was found.
        before: what 0.1.0 did.
        reproduce: gives what happens now, in an empty folder.
    """

    name: str
    title: str
    before: str
    reproduce: Callable[[Path], Now]


def _shipped(cell: str = "surface_follow_sim", **changes: Any) -> dict[str, Any]:
    data: dict[str, Any] = yaml.safe_load((CONFIGS / f"{cell}.yaml").read_text())
    return data | changes


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


def _cli(*arguments: object, folder: Path, shell: str = "", timeout_s: float = 120.0) -> tuple[int, str]:
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


def _with(data: dict[str, Any], key: str, value: Any) -> dict[str, Any]:
    """A copy of ``data`` with ``value`` at a dotted key; None removes it."""
    copy: dict[str, Any] = yaml.safe_load(yaml.safe_dump(data))
    *path, last = key.split(".")
    inner = copy
    for part in path:
        inner = inner[part]
    if value is None:
        del inner[last]
    else:
        inner[last] = value
    return copy


# Safety


def s1(folder: Path) -> Now:
    """Every moved arm needs bounds of its own, within reason."""
    both, one = _shipped("dual_push_sim"), _shipped()
    return _refused(
        folder,
        {
            "no box for the follower": _with(both, "interlocks.follower_box", None),
            "the other arm's sensor": _with(both, "interlocks.leader_box.sensor", "follower_sensor"),
            "a box of 2 km": _with(
                _with(one, "interlocks.workspace.max_mm", [1e6] * 3), "interlocks.workspace.min_mm", [-1e6] * 3
            ),
            "100 m/s": _with(one, "interlocks.tcp_speed.limit_m_s", 100),
            "frames of 1e9 ms": _with(one, "interlocks.stale_frame.limit_ms", 1e9),
            "depth 500 mm": _with(one, "interlocks.indentation.limit_mm", 500),
            "no margin": _with(one, "interlocks.workspace.margin_mm", None),
        },
    )


def s2(folder: Path) -> Now:
    """Interlocks that can never trip."""
    both, one = _shipped("dual_push_sim"), _shipped()
    truth = _true_contact(_shipped())
    unfiltered = _with(one, "sensors.sensor.estimator.filter", None)
    unfiltered["interlocks"]["inconsistent"] = {"kind": "inconsistent", "limit_nis": 22.5, "frames": 5}
    step = {"kind": "out_of_step", "limit_mm_s": 30, "limit_mm": 4, "hold_ms": 100, "leader": "ledaer"}
    lost = {"kind": "contact_lost", "limit_ms": 500, "states": ["setle", "rnu"]}
    return _refused(
        folder,
        {
            "states: [setle, rnu]": _with(one, "interlocks.lost", lost),
            "leader: ledaer": _with(both, "interlocks.step", step),
            "inconsistent without a filter": unfiltered,
            "uncertain on true contact": _with(truth, "interlocks.sure", {"kind": "uncertain", "limit_mm": 1}),
        },
    )


def s3(folder: Path) -> Now:
    """A depth limit beyond what the network was taught."""
    answer = _check(folder, _with(_shipped(), "interlocks.indentation.limit_mm", 9))
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


def s7(folder: Path) -> Now:
    """One driver's exception, and the other arm."""
    from touchcell.cell.runtime.compose import compose
    from touchcell.cell.runtime.loop import RunLoop

    stop = StopRequest()
    path = _file(folder, _true_contact(_shipped("dual_push_sim")))
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
    data = _true_contact(_shipped())
    data["interlocks"]["workspace"]["max_mm"] = [-72, 50, 150]
    return _file(folder, data, "trip.yaml")


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


# Use


def a1(folder: Path) -> Now:
    """Torch missing; the reason of a failed run."""
    program = "import sys; sys.modules['torch'] = None; from touchcell.cell.cli.main import main; sys.exit(main())"
    command = [sys.executable, "-c", program, "train", "--data", str(folder), "--out", str(folder / "m.safetensors")]
    told = subprocess.run(command, cwd=CHECKOUT, capture_output=True, text=True, check=False, timeout=120).stderr
    data = _true_contact(_shipped())
    data["arms"]["arm"]["start_pose_mm_deg"] = [-80, 0, 120, 180, 0, 0]
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
    """The pose that `probe` prints."""
    raise NotImplementedError("needs the UR emulator: tests/emulated/test_ur.py")


def a3(folder: Path) -> Now:
    """What the wheel installs."""
    import tomllib

    settings = tomllib.loads((CHECKOUT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"]["find"]
    found = {name.partition(".")[0] for name in settings["include"]}
    return Now(f"top level of the wheel: {', '.join(sorted(found))}", found == {"touchcell"})


def a4(folder: Path) -> Now:
    """Names that leave the folder of runs."""
    names = ("../../evil", "", "x" * 400, "a/b", "..")
    return _refused(folder, {repr(name)[:20]: _shipped(name=name) for name in names})


def a5(folder: Path) -> Now:
    """Models that are not there."""
    (folder / "d").mkdir()
    answers = [
        _check(folder, _with(_shipped(), "sensors.sensor.estimator.model", model))
        for model in ("builtin:sim_gnd", "none.safetensors", "d")
    ]
    fixed = "sim_gdn" in answers[0] and "train --data DIR --out" in answers[1] and "is no file" in answers[2]
    return Now("; ".join(answer.partition("model: ")[2][:40] for answer in answers), fixed)


def a6(folder: Path) -> Now:
    """The example of the safety page, pasted into the shipped cell."""
    page = next(CHECKOUT.glob("docs/**/safety.md")).read_text()
    block = next(part for part in page.split("```yaml\n")[1:] if "clear:" in part).partition("```")[0]
    data, example = _true_contact(_shipped("dual_push_sim")), yaml.safe_load(block)
    for section in ("arms", "interlocks"):
        for name, entry in example[section].items():
            data[section][name] = data[section].get(name, {}) | entry
    data["obstacles"] = example["obstacles"]
    if answer := _check(folder, data):
        return Now(f"check: {answer}", False)
    code, told = _quiet("run", folder / "cell.yaml", "--out", folder / "o", "--quiet")
    return Now(_first(told), code == 0)


def _bomb() -> bytes:
    rows = [b"%c: &%c [%s]" % (i, i, b", ".join([b"*%c" % (i - 1)] * 9)) for i in b"bcdefghij"]
    return b"\n".join([b"a: &a [x]", *rows])


def a7(folder: Path) -> Now:
    """Tracebacks."""
    good = _file(folder, _shipped(), "good.yaml")
    files: dict[str, bytes] = {
        "binary": bytes(range(256)),
        "gzip": gzip.compress(b"schema: 1"),
        "latin-1": "name: ä".encode("latin-1"),
        "UTF-16": "name: x".encode("utf-16"),
        "self": b"loop: &a [*a]",
        "key": b"? [a, b]\n: c",
        "bomb": _bomb(),
    }
    commands: dict[str, list[object]] = {
        name: ["check", _file(folder, data, f"{name}.yaml")] for name, data in files.items()
    }
    (folder / "file").touch()
    commands |= {
        "--out a file": ["run", good, "--out", folder / "file", "--quiet"],
        "--out no parent": ["run", good, "--out", folder / "file" / "x", "--quiet"],
        "--port 80000": ["view", folder, "--port", 80000],
        "--port -5": ["view", folder, "--port", -5],
        "--jobs -3": ["experiment", "surface_following", "--jobs", -3, "--quick"],
        "--trials -1": ["experiment", "surface_following", "--trials", -1],
        "emulate no file": ["emulate", "cell", folder / "none.yaml"],
        "emulate a simulated cell": ["emulate", "cell", good],
        "emulate --host 8.8.8.8": ["emulate", "ur", "--host", "8.8.8.8"],
    }
    traced = []
    for name, command in commands.items():
        code, told = _cli(*command, folder=folder)
        if "Traceback" in told or code in (0, 1):
            traced.append(f"{name} ({code})")
    text = f"{len(commands) - len(traced)} of {len(commands)} are one message"
    return Now(text + (f"; not: {', '.join(traced)}" if traced else ""), not traced)


def a8(folder: Path) -> Now:
    """What `check` accepted and `run` refused or tripped on."""
    one = _shipped()
    gate = {"touch_percent": 2.5, "release_percent": 4}
    return _refused(
        folder,
        {
            "sensor: sensr": _with(one, "interlocks.workspace.sensor", "sensr"),
            "no model": _with(one, "sensors.sensor.estimator.model", "none.safetensors"),
            "a folder as model": _with(one, "sensors.sensor.estimator.model", "."),
            "text as model": _with(one, "sensors.sensor.estimator.model", "cell.yaml"),
            "no scene": _with(one, "scene", None),
            "empty scene": _with(one, "scene", {}),
            "gate reversed": _with(one, "sensors.sensor.estimator.gate", gate),
            "depth 8 of 6": _with(one, "task.depth_mm", 8),
            "500 mm/s": _with(one, "task.speed_mm_s", 500),
            "start outside": _with(one, "arms.arm.start_pose_mm_deg", [-800, 0, 25, 180, 0, 0]),
            "1e30 mm": _with(one, "task.distance_mm", 1e30),
            "no calibration": _with(one, "sensors.sensor.estimator.calibration", "none.yaml"),
            "rate_hz: yes": yaml.safe_dump(_with(one, "rate_hz", 1)).replace("rate_hz: 1\n", "rate_hz: yes\n"),
            "seed: 1:30": yaml.safe_dump(_with(one, "seed", 7)).replace("seed: 7\n", "seed: 1:30\n"),
        },
    )


def a9(folder: Path) -> Now:
    """Messages with a wrong remedy."""
    one, text = _shipped(), (CONFIGS / "surface_follow_sim.yaml").read_text()
    wanted: list[tuple[Mapping[str, Any] | str, str]] = [
        (_with(one, "arms.arm.start_pose_mm_deg", [1, 2, 3, 4, 5]), "needs six numbers"),
        (_with(one, "schema", None), "(add `schema: 1`)"),
        (one | {"schma": 1}, "did you mean 'schema'"),
        (_with(one, "interlocks.workspace.min_mm", [0, 0, 500]), " interlocks.workspace: min_mm"),
        (_with(one, "scene.surfaces.ramp.kind", "rampp"), "did you mean 'ramp'"),
        (_with(one, "interlocks.indentation.kind", "deptth"), "did you mean 'depth'"),
        (text.replace("    driver: sim_arm", "\tdriver: sim_arm"), "use spaces"),
        (_with(one, "arms.arm.driver", "sim_tactip"), "not an arm"),
    ]
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
    data = _true_contact(_shipped())
    data["arms"]["arm"]["start_pose_mm_deg"] = [-80, 0, 120, 180, 0, 0]
    _, told = _cli(
        "run", _file(folder, data), "--quiet", folder=folder, shell='"$@" | head -1; echo "code ${PIPESTATUS[0]}"'
    )
    code = told.split("code ")[-1].split()[0]
    return Now(f"exit {code}", code == "1")


def a12(folder: Path) -> Now:
    """Warnings on the user's terminal."""
    data = _true_contact(_shipped())
    data["arms"]["arm"]["start_pose_mm_deg"] = [-80, 0, 120, 180, 0, 0]
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
    Row("S7", "one driver's OSError at a stop", "step() raised; the other arm was told late", s7),
    Row("R1", "a second run into one folder", "exit 0, recording replaced", r1),
    Row("R2", "exit code of a trip in a pipe", "| true: 0; >/dev/full: 1 with a traceback", r2),
    Row("R3", "key r without a passwd entry", "KeyError, no result, no black box", r3),
    Row("R4", "black box after kill -9, SIGSEGV", "none in one process", r4),
    Row("R5", "request.json that is no request", "OverflowError, RecursionError end the run", r5),
    Row("R6", "damaged recordings", "547 of 2072 tracebacks, changed values read; bomb 348 s", r6),
    Row("R7", "a loop that hangs 0.5 s", "done, no violation", r7),
    Row("R8", "YAML fuzz; first command from rest", "2341 of 9475 tracebacks; 0 to 100 mm/s at once", r8),
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
        except NotImplementedError as error:
            return "not tried", str(error)
        except Exception as error:
            return "OPEN", f"{type(error).__name__}: {_first(str(error))}"
        finally:
            logging.disable(logging.NOTSET)
            os.chdir(before)
    return ("fixed" if now.fixed else "OPEN"), now.text


def run(arguments: Sequence[str], out: Path) -> None:
    """Print the table of all rows, or of those named; write ``findings.json`` into ``out``."""
    rows = [row for row in ROWS if not arguments or row.name in arguments]
    found = {}
    for row in rows:
        verdict, text = reproduced(row)
        found[row.name] = {"title": row.title, "before": row.before, "now": text, "verdict": verdict}
        print(f"{row.name:<4} {verdict:<10} {row.title}")
        for label, words in (("0.1.0", row.before), ("now", text)):
            print(
                textwrap.fill(words, 116, initial_indent=f"       {label:<6} ", subsequent_indent=" " * 14), flush=True
            )
    counts = {
        verdict: sum(each["verdict"] == verdict for each in found.values())
        for verdict in ("fixed", "OPEN", "not tried")
    }
    print(", ".join(f"{count} {verdict}" for verdict, count in counts.items()))
    (out / "findings.json").write_text(json.dumps(found, indent=1) + "\n")
