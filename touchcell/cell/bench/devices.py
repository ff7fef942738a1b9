"""``touchcell bench devices``: every driver on its emulator, and the vendor's client beside it.

All figures are of this machine and of emulators, never of metal. It works with the conformance suite's bench, so it
needs pytest (extra ``dev``).
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from touchcell.cell.bench.provenance import provenance
from touchcell.drivers.core.errors import DeviceError
from touchcell.drivers.core.protocols import TwistSink
from touchcell.testing.conformance.client import MovingClient
from touchcell.testing.conformance.context import ConformanceContext, DeviceUnderTest
from touchcell.testing.emulation.rig import RIGS

_RIGS = ("ur", "franka", "damiao_can", "feetech_serial", "v4l2")
_TRIALS = 20
_CALM_S = 0.12
_ONSET_S = 0.3
_TTL_S = 0.2
_CLIENT_TIMEOUT_S = 30.0
_COLUMNS = (
    ("connect_s", "connect s", ".3f"),
    ("active_s", "active s", ".3f"),
    ("rate_hz", "state Hz", ".0f"),
    ("age_ms", "age ms", ".1f"),
    ("wire_ms", "wire ms", ".2f"),
    ("wire_p99_ms", "p99 ms", ".2f"),
    ("cycle_cpu_us", "cycle us", ".0f"),
    ("stop_ttl_ms", "ttl ms", ".0f"),
    ("stop_kill_ms", "kill ms", ".0f"),
    ("stop_kill_mm", "kill mm", ".1f"),
    ("frozen_ms", "frozen ms", ".0f"),
    ("memory_mb", "MB", ".0f"),
)


def run(arguments: Sequence[str], out: Path) -> None:
    """Print the table; writes ``devices.json`` into ``out``."""
    parser = argparse.ArgumentParser(prog="touchcell bench devices", description=__doc__.partition("\n")[0])
    parser.add_argument("names", nargs="*", default=_RIGS, metavar="driver", help=f"of {', '.join(_RIGS)}")
    names = parser.parse_args(arguments).names
    rows: dict[str, dict[str, Any]] = {}
    for number, name in enumerate(names):
        print(f"{name} ...", flush=True)
        with tempfile.TemporaryDirectory(prefix="touchcell-bench-") as folder:
            address = 1000 + (os.getpid() % 30_000) * 16 + number
            device = DeviceUnderTest(RIGS.load(name), Path(folder), address)
            try:
                rows[name] = _measure(name, device)
                rows[f"{name}, vendor"] = _vendor(name, device)
            finally:
                device.clear()
    print(f"\n{'':<24}" + "".join(f"{title:>11}" for _, title, _ in _COLUMNS))
    for name, row in rows.items():
        cells = (f"{format(row[key], form) if row.get(key) is not None else '-':>11}" for key, _, form in _COLUMNS)
        print(f"{name:<24}" + "".join(cells) + (f"  {row['error']}" if "error" in row else ""))
    print(
        "\nwire: from send_twist to the emulator's receive stamp, from rest; of coarse servos to a whole step."
        "\nttl, kill: from expiry or kill -9 until the tool rests, or the motors of an arm without brakes let go."
        "\nfrozen: until the driver is FAULTED."
    )
    out.mkdir(parents=True, exist_ok=True)
    (out / "devices.json").write_text(json.dumps({"provenance": provenance(), "rows": rows}, indent=1) + "\n")


def _measure(name: str, device: DeviceUnderTest) -> dict[str, Any]:
    device.emulator()
    row = _client("ours", device, name)
    for part in (_wire, _ttl, _kill, _frozen):
        device.clear()
        if TwistSink in device.rig.spec.capabilities.provides or part is _frozen:
            try:
                row |= part(device)
            except BaseException as error:
                if isinstance(error, KeyboardInterrupt):
                    raise
                row["error"] = f"{part.__name__.strip('_')}: {error}"
    device.clear()
    return row


def _vendor(name: str, device: DeviceUnderTest) -> dict[str, Any]:
    device.emulator()
    return _client("vendor", device, name)


def _client(who: str, device: DeviceUnderTest, name: str) -> dict[str, Any]:
    environment = dict(os.environ)
    if name == "v4l2":
        from touchcell.drivers.v4l2.shim import environment as shim

        environment |= shim(device.folder)
    try:
        result = subprocess.run(
            [
                sys.executable,
                "-W",
                "ignore",
                "-m",
                "touchcell.cell.bench.device_client",
                who,
                name,
                device.folder,
                str(device.address),
            ],
            capture_output=True,
            text=True,
            timeout=_CLIENT_TIMEOUT_S,
            env=environment,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return {"error": f"no figures within {_CLIENT_TIMEOUT_S:g} s"}
    if result.returncode:
        return {"error": result.stderr.strip().splitlines()[-1]}
    row: dict[str, Any] = json.loads(result.stdout.splitlines()[-1])
    return row


def _wire(device: DeviceUnderTest) -> dict[str, Any]:
    """From the call of ``send_twist`` to the emulator's own receive stamp, each time from rest."""
    context = ConformanceContext(device)
    try:
        lease = context.leased()
        context.settle()
        latencies_ms = []
        for trial in range(_TRIALS):
            context.sleep(_CALM_S)
            sign = 1.0 if trial % 2 else -1.0
            twist = sign * context.twist(context.axis())
            before_ns = time.monotonic_ns()
            context.arm.send_twist(context.command(twist), lease)
            # A servo with coarse steps is told nothing new until the motion has come to a whole one.
            while (onset_ns := context.truth()["command_onset_ns"]) <= before_ns:
                if time.monotonic_ns() - before_ns > _ONSET_S * 1e9:
                    break
                context.sleep(0.005)
                context.arm.send_twist(context.command(twist), lease)
            else:
                latencies_ms.append((onset_ns - before_ns) * 1e-6)
            context.arm.stop()
            context.settle()
        return {
            "wire_ms": statistics.median(latencies_ms),
            "wire_p99_ms": float(np.percentile(latencies_ms, 99)),
            "wire_trials": len(latencies_ms),
        }
    finally:
        context.close()


def _ttl(device: DeviceUnderTest) -> dict[str, Any]:
    """From the expiry of the last command until the tool truly rests."""
    context = ConformanceContext(device)
    try:
        lease = context.leased()
        context.settle()
        track, _ = context.stream(lease, context.twist(context.axis()), 0.6, ttl_s=_TTL_S)
        expiry_ns = track.t_ns[-1] + _TTL_S * 1e9
        rest = context.track_to_rest(3.0)
        return {"stop_ttl_ms": (rest.t_ns[-1] - expiry_ns) * 1e-6}
    finally:
        context.close()


def _kill(device: DeviceUnderTest) -> dict[str, Any]:
    """From kill -9 of the client until the tool rests, or motors that carry an arm without brakes let go."""
    context = ConformanceContext(device)
    falls = device.rig.spec.capabilities.falls_on_power_loss
    try:
        with MovingClient(device.function, device.folder, device.address, context.speed()) as client:
            context.sleep(0.3)
            client.kill()
            start_ns, start = context.clock.now_ns(), context.position()
            ended = (lambda truth: not truth["energised"]) if falls else None
            rest = context.track_to_rest(client.silence_s + 3.0, ended)
        travel_mm = 1e3 * float(np.linalg.norm(rest.poses[-1][:3, 3] - start))
        return {"stop_kill_ms": (rest.t_ns[-1] - start_ns) * 1e-6, "stop_kill_mm": travel_mm}
    finally:
        context.close()


def _frozen(device: DeviceUnderTest) -> dict[str, Any]:
    """From SIGSTOP of the device until the driver is FAULTED."""
    context = ConformanceContext(device)
    context.spoiled = True
    try:
        context.active()
        lease = context.arm.acquire("bench") if TwistSink in device.rig.spec.capabilities.provides else None
        with suppress(DeviceError):
            context.read()
        context.sleep(0.2)
        context.emulator.freeze()
        return {"frozen_ms": 1e3 * context.reach_faulted(5.0, lease)}
    finally:
        context.close()
