"""``touchcell bench zoo``: public bug reports of arms and cameras, each tried on our driver beside its emulator.

The rows are data (``zoo.yaml``): source, failure, injection, expected reaction. With ``--peers`` the same injection is
tried on an unmodified public client of the same wire, where one is installed. All results are of emulators.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml
from pydantic import BaseModel, ConfigDict, ValidationError

from touchcell.cell.bench.provenance import provenance
from touchcell.cell.bench.zoo_peers import PEER_CLIENTS, PeerProcess
from touchcell.drivers.core.arm import Arm
from touchcell.drivers.core.camera import Camera
from touchcell.drivers.core.commands import TwistCommand, TwistFrame
from touchcell.drivers.core.device import Device, Lifecycle, OperatorToken
from touchcell.drivers.core.errors import DeviceError, TransportTimeout
from touchcell.drivers.core.lease import Lease
from touchcell.drivers.core.paced_clock import emulated_clock
from touchcell.drivers.core.protocols import HealthSource
from touchcell.errors import ConfigError
from touchcell.testing.emulation.rig import RIGS, RIGS_IN_STEP, DeviceFixture, Emulated

_ROWS = Path(__file__).with_name("zoo.yaml")
_CALM_S = 0.5
_NOTICED_S = 4.0
_SHOWN_S = 3.0
_STEP_S = 0.01
_STARTS = 2
_TRIES = 2
_SLOW_M_S = 0.002
_TTL_S = 0.2
_STILL_DEG = 0.2
_RECOVERY_S = 8.0
_FIRST_ADDRESS = 20_000
_TROUBLE = (
    *("bad", "lost", "corrupt", "error", "missed", "not_sent", "not_received", "implausible", "late", "out_of"),
    *("unexpected", "frozen", "dropped"),
)

Expected = Literal["refused", "fault", "counted", "harmless", "recovers", "still", "shown"]


class ZooRow(BaseModel):
    """One public report.

    Attributes:
        source: project and number, or manual.
        failure: what happened to the people who reported it.
        driver: which of ours it is tried on.
        when: injected before the connection, while the device is active, or while a device that is FAULTED by
            ``inject`` waits for a person (``then`` is injected, ``inject`` ends, and the person recovers it).
        inject: faults of the emulator, by name, with their values.
        then: further faults, for ``replug``.
        settings: changed settings of the device, by dotted key.
        shows: readings of ``health`` that must appear: a text, a boolean, or [least, most].
        real_time: needs a wire of the machine's own, and so its time.
        expect: reaction that is right; see ``zoo.yaml``.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    source: str
    failure: str
    driver: str
    when: Literal["before", "active", "replug"]
    inject: dict[str, Any] = {}
    then: dict[str, Any] = {}
    settings: dict[str, Any] = {}
    shows: dict[str, Any] = {}
    real_time: bool = False
    expect: Expected


def rows() -> list[ZooRow]:
    """Return all reports."""
    return [ZooRow.model_validate(row) for row in yaml.safe_load(_ROWS.read_text())]


def try_row(row: ZooRow, fixture: DeviceFixture) -> tuple[str, str]:
    """Inject one report; return the reaction, as ``ZooRow.expect`` has it or "not noticed", and its message."""
    emulated = _started(fixture)
    device: Device | None = None
    try:
        device = _build(row, fixture)
        if row.when == "before":
            return _before(row, device, emulated)
        return _active(row, device, emulated) if row.when == "active" else _replug(row, device, emulated)
    except (ConfigError, DeviceError, ValidationError) as error:
        return "refused", str(error)
    finally:
        if device is not None:
            with suppress(DeviceError):
                device.disconnect()
        emulated.stop()


def try_peer(row: ZooRow, fixture: DeviceFixture, folder: Path) -> tuple[str, str]:
    """Inject one report beside a public client; return its reaction and message, or "-" where it cannot be tried."""
    peer = PEER_CLIENTS.get(row.driver)
    if peer is None or not peer.installed or row.settings or row.when == "replug":
        return "-", ""
    if row.expect not in ("refused", "fault", "counted", "harmless"):
        return "-", ""
    assert fixture.config is not None
    emulated = _started(fixture)
    try:
        if row.when == "before":
            _inject(row.inject, emulated)
        with PeerProcess(peer, fixture.config, folder) as client:
            trouble = client.started()
            if trouble is not None:
                return "refused", trouble
            if row.when == "active":
                _inject(row.inject, emulated)
            trouble = client.trouble_within(_NOTICED_S if row.expect == "fault" else 2 * _CALM_S)
            return ("not noticed", "") if trouble is None else ("fault", trouble)
    finally:
        emulated.stop()


def is_handled(row: ZooRow, found: str) -> bool:
    """Return whether a reaction is the right one; what is harmless may be counted too."""
    return found == row.expect or (row.expect == "harmless" and found == "counted")


def run(arguments: Sequence[str], out: Path) -> None:
    """Print one line for each report; writes ``zoo.json`` into ``out``."""
    parser = argparse.ArgumentParser(prog="touchcell bench zoo", description=__doc__.partition("\n")[0])
    parser.add_argument("drivers", nargs="*", metavar="driver", help="only reports of these drivers")
    parser.add_argument("--peers", action="store_true", help="try public clients of the same wire too")
    parser.add_argument("--match", default="", help="only reports whose source or failure has this text")
    options = parser.parse_args(arguments)
    known = sorted({row.driver for row in rows()})
    for name in options.drivers:
        if name not in known:
            raise ConfigError(f"no report is of {name!r}", key="driver", value=name, hint=f"known: {', '.join(known)}")
    results: list[dict[str, Any]] = []
    for number, row in enumerate(rows()):
        if options.drivers and row.driver not in options.drivers:
            continue
        if options.match.lower() in f"{row.source} {row.failure}".lower():
            results.append(_try_and_print(row, number, peers=options.peers))
            # After each, as a run of all takes a quarter of an hour.
            _write(results, out)
    print(f"\n{sum(bool(result['handled']) for result in results)} of {len(results)} handled, on emulators")
    if options.peers:
        _print_peers(results)


def _write(results: Sequence[Mapping[str, Any]], out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    (out / "zoo.json").write_text(json.dumps({"provenance": provenance(), "rows": results}, indent=1) + "\n")


def _try_and_print(row: ZooRow, number: int, *, peers: bool) -> dict[str, Any]:
    with tempfile.TemporaryDirectory(prefix="touchcell-zoo-") as name:
        folder = Path(name)
        rig = RIGS.load(row.driver)
        # Where driver and emulator share a simulated time, a busy machine changes nothing.
        shares_time = row.driver in RIGS_IN_STEP.names() and not row.real_time
        in_step = RIGS_IN_STEP.load(row.driver) if shares_time else rig
        tries, found, message = 0, "", ""
        # A machine that is busy starves emulators and drivers; what is not handled twice is not handled.
        while tries < _TRIES and not is_handled(row, found):
            tries += 1
            fixture = in_step(folder, _FIRST_ADDRESS + 2 * number)
            try:
                with fixture.world:
                    found, message = try_row(row, fixture)
            except (TimeoutError, TransportTimeout) as error:
                found, message = "not tried", f"the emulator did not answer: {error}"
        result = {
            **row.model_dump(),
            "found": found,
            "handled": is_handled(row, found),
            "tries": tries,
            "message": message,
        }
        verdict = (
            ("handled" if tries == 1 else "handled at the second try")
            if result["handled"]
            else f"NOT HANDLED ({row.expect} expected, {found})"
        )
        if peers:
            try:
                theirs, why = try_peer(row, rig(folder, _FIRST_ADDRESS + 2 * number + 1), folder)
            except (TimeoutError, TransportTimeout) as error:
                theirs, why = "-", f"the emulator did not answer: {error}"
            result |= {"peer": theirs, "peer_message": why, "peer_handled": _peer_handled(row, theirs)}
            verdict = f"{verdict:<12}{_peer_verdict(row, theirs)}"
    print(f"{row.driver:<15}{row.source:<42}{row.failure:<58}{verdict}", flush=True)
    if message:
        print(f"{'':<15}{message.splitlines()[0]}")
    return result


def _peer_handled(row: ZooRow, found: str) -> bool | None:
    if found == "-":
        return None
    if row.expect in ("counted", "harmless"):
        return found == "not noticed"
    return found in ("refused", "fault")


def _peer_verdict(row: ZooRow, found: str) -> str:
    handled = _peer_handled(row, found)
    if handled is None:
        return "-"
    name = PEER_CLIENTS[row.driver].name
    return f"{name}: handled" if handled else f"{name}: {'ends' if found != 'not noticed' else found}"


def _print_peers(results: Sequence[Mapping[str, Any]]) -> None:
    for driver, peer in PEER_CLIENTS.items():
        tried = [result for result in results if result["driver"] == driver and result["peer_handled"] is not None]
        if tried:
            theirs, ours = (sum(bool(each[key]) for each in tried) for key in ("peer_handled", "handled"))
            print(f"of the same {len(tried)} reports: {peer.name} {theirs}, {driver} {ours}")


def _started(fixture: DeviceFixture) -> Emulated:
    """Start the emulator; a machine that is busy may need several tries. Raises TransportTimeout."""
    assert fixture.start is not None
    for _ in range(_STARTS):
        with suppress(TransportTimeout):
            return fixture.start()
    return fixture.start()


def _build(row: ZooRow, fixture: DeviceFixture) -> Device:
    if not row.settings:
        return fixture.build(fixture.clock())
    assert fixture.config is not None
    assert fixture.configured is not None
    settings: Any = fixture.config.model_dump(mode="json", exclude_unset=True)
    for key, value in row.settings.items():
        *parents, last = [int(part) if part.isdigit() else part for part in key.split(".")]
        place = settings
        for parent in parents:
            place = place[parent]
        place[last] = value
    return fixture.configured(type(fixture.config).model_validate(settings), fixture.clock())


def _inject(faults: Mapping[str, Any], emulated: Emulated) -> None:
    for fault, value in faults.items():
        emulated.fault(fault, value)


def _before(row: ZooRow, device: Device, emulated: Emulated) -> tuple[str, str]:
    _inject(row.inject, emulated)
    start = _joints(emulated)
    try:
        _activate(device)
    except DeviceError as error:
        return "refused", str(device.fault or error)
    except ConfigError as error:
        return "refused", str(error)
    if row.expect == "still":
        return _moved(emulated, start)
    lease = _lease(device)
    if row.shows:
        return _shown(row, device, lease)
    if _until(lambda: _faulted(device, lease), _CALM_S):
        return "fault", str(device.fault)
    return "harmless", ""


def _active(row: ZooRow, device: Device, emulated: Emulated) -> tuple[str, str]:
    _activate(device)
    lease = _lease(device)
    _until(lambda: _faulted(device, lease), _CALM_S)
    before = _counts(device)
    _inject(row.inject, emulated)
    if row.shows:
        return _shown(row, device, lease)
    if row.expect in ("recovers", "still"):
        _until(lambda: _faulted(device, lease), _NOTICED_S)
        return _recovered(row, device, emulated, lease)
    if _until(lambda: _faulted(device, lease), _NOTICED_S if row.expect == "fault" else 2 * _CALM_S):
        return "fault", str(device.fault)
    grown = [name for name, count in _counts(device).items() if count > before.get(name, 0) and _is_trouble(name)]
    if grown:
        return "counted", f"health: {', '.join(grown)}"
    return ("harmless" if row.expect == "harmless" else "not noticed"), ""


def _replug(row: ZooRow, device: Device, emulated: Emulated) -> tuple[str, str]:
    _activate(device)
    lease = _lease(device)
    _inject(row.inject, emulated)
    if not _until(lambda: _faulted(device, lease), _NOTICED_S):
        return "not noticed", ""
    _inject(row.then, emulated)
    return _recovered(row, device, emulated, lease)


def _recovered(row: ZooRow, device: Device, emulated: Emulated, lease: Lease | None) -> tuple[str, str]:
    for fault in row.inject:
        emulated.clear(fault)
    first = str(device.fault or "")
    stood = _joints(emulated)
    deadline_s = _now_s() + _RECOVERY_S
    while device.state is Lifecycle.FAULTED:
        try:
            device.recover(OperatorToken("zoo", emulated_clock().now_ns()))
        except (DeviceError, ConfigError) as error:
            if row.expect == "refused" or _now_s() > deadline_s:
                return "refused", str(error)
            _pause()
    while device.state is Lifecycle.READY:
        # An arm that loses its power with a delay refuses the first time.
        try:
            device.activate()
        except DeviceError as error:
            if _now_s() > deadline_s:
                return "refused", str(error)
            _pause()
    if row.expect == "still":
        return _moved(emulated, stood)
    if isinstance(device, Arm) and device.owner is None:
        lease = _lease(device)
    if _until(lambda: _faulted(device, lease), _CALM_S):
        return "fault", str(device.fault)
    return "recovers", f"after: {first}"


def _shown(row: ZooRow, device: Device, lease: Lease | None) -> tuple[str, str]:
    missing: list[str] = []

    def all_shown() -> bool:
        _faulted(device, lease)
        assert isinstance(device, HealthSource)
        readings = device.health()
        missing[:] = [
            f"{name} {readings.get(name)}"
            for name, wanted in row.shows.items()
            if not _matches(readings.get(name), wanted)
        ]
        return not missing

    if _until(all_shown, _SHOWN_S):
        return "shown", f"health: {', '.join(row.shows)}"
    return "not noticed", f"health has {', '.join(missing)}"


def _matches(found: Any, wanted: Any) -> bool:
    if isinstance(wanted, list):
        return isinstance(found, int | float) and bool(wanted[0] <= found <= wanted[1])
    return bool(found == wanted)


def _joints(emulated: Emulated) -> Any:
    # Not the tool, which activation may set.
    state = emulated.state()
    return state["q"] if "q" in state else state.get("q_rad", ())


def _moved(emulated: Emulated, start: Any) -> tuple[str, str]:
    deadline_s = _now_s() + _CALM_S
    farthest_deg = 0.0
    while _now_s() < deadline_s:
        moved = np.rad2deg(np.abs(np.subtract(_joints(emulated), start)))
        farthest_deg = max(farthest_deg, float(moved.max(initial=0.0)))
        _pause()
    what = f"a joint moved {farthest_deg:.3f} deg"
    return ("still" if farthest_deg <= _STILL_DEG else what), what


def _now_s() -> float:
    return 1e-9 * emulated_clock().now_ns()


def _pause() -> None:
    clock = emulated_clock()
    clock.sleep_until_ns(clock.now_ns() + round(1e9 * _STEP_S))


def _activate(device: Device) -> None:
    device.connect()
    device.configure()
    device.activate()


def _lease(device: Device) -> Lease | None:
    return device.acquire("zoo") if isinstance(device, Arm) else None


def _faulted(device: Device, lease: Lease | None) -> bool:
    """Use the device as a task does; return whether it is FAULTED."""
    with suppress(DeviceError):
        if isinstance(device, Camera):
            device.latest()
        elif isinstance(device, Arm) and lease is not None:
            twist = np.array([0.0, 0.0, _SLOW_M_S, 0.0, 0.0, 0.0])
            device.tcp()
            device.send_twist(TwistCommand(twist, TwistFrame.BASE, emulated_clock().now_ns(), _TTL_S), lease)
    return device.state is Lifecycle.FAULTED


def _counts(device: Device) -> dict[str, float]:
    if not isinstance(device, HealthSource):
        return {}
    return {name: value for name, value in device.health().items() if isinstance(value, int | float)}


def _is_trouble(name: str) -> bool:
    return any(word in name for word in _TROUBLE) and not name.startswith("latest")


def _until(condition: Callable[[], bool], seconds: float) -> bool:
    deadline_s = _now_s() + seconds
    while _now_s() < deadline_s:
        if condition():
            return True
        _pause()
    return False
