"""What armed coverage refuses: of the shipped cells, and of cells one of whose interlocks was changed at random.

    python -m benchmarks armed [--cells N] [--seed S]

Whether a change disarms a rule is known from how it was made, not from the proof: a limit of minutes for an age, of a
hundred times the speed of the arm, of an indentation deeper than the tip is thick, a role or a state that the
task does not have, a box of a kilometre, a rule that is left out or only slows down. Changes of the other kind keep the
rule as good as it was: limits a little tighter or wider, other times to hold, a rule that nothing requires left out. A
verdict is right if the cell is refused exactly when it was disarmed, and refused below ``interlocks``.
"""

from __future__ import annotations

import argparse
import copy
import json
import random
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from touchcell.cell.bench.provenance import provenance
from touchcell.cell.config.armed import REQUIRED_OF_ARMS, REQUIRED_OF_NETWORKS, REQUIRED_OF_SENSORS
from touchcell.cell.config.layers import load_layers
from touchcell.cell.config.schema import plan_cell
from touchcell.errors import ConfigError
from touchcell.paths import CONFIGS

Entry = dict[str, Any]
_REQUIRED = (*REQUIRED_OF_ARMS, *REQUIRED_OF_SENSORS, *REQUIRED_OF_NETWORKS)
_TIMES = ("frame_age", "arm_state_age", "frame_frozen", "out_of_range", "contact_lost", "limited")


@dataclass(frozen=True, slots=True)
class Change:
    """One way to change an interlock.

    Attributes:
        what: description.
        disarms: whether the rule, or its place, protects nothing any more.
        kinds: of interlocks that can be changed so; empty for all.
        apply: changes a copy of the entry; None to leave the rule out.
    """

    what: str
    disarms: bool
    kinds: tuple[str, ...]
    apply: Callable[[Entry, random.Random], Entry | None]


def _scaled(key: str, low: float, high: float) -> Callable[[Entry, random.Random], Entry]:
    def apply(entry: Entry, chance: random.Random) -> Entry:
        # Evenly by orders of magnitude.
        value = entry[key] * low * (high / low) ** chance.random()
        return {**entry, key: round(value) if isinstance(entry[key], int) and key == "frames" else value}

    return apply


def _set(**changes: Any) -> Callable[[Entry, random.Random], Entry]:
    return lambda entry, chance: {**entry, **changes}


def _leave_out(entry: Entry, chance: random.Random) -> None:
    return None


def _without_a_letter(key: str) -> Callable[[Entry, random.Random], Entry]:
    def apply(entry: Entry, chance: random.Random) -> Entry:
        at = chance.randrange(len(entry[key]))
        return {**entry, key: entry[key][:at] + entry[key][at + 1 :]}

    return apply


def _walls(low_mm: float, high_mm: float) -> Callable[[Entry, random.Random], Entry]:
    def apply(entry: Entry, chance: random.Random) -> Entry:
        by_mm = chance.uniform(low_mm, high_mm)
        return {
            **entry,
            "min_mm": [each - by_mm for each in entry["min_mm"]],
            "max_mm": [each + by_mm for each in entry["max_mm"]],
        }

    return apply


CHANGES = (
    Change("age or duration of minutes", True, _TIMES, _scaled("limit_ms", 1e3, 1e6)),
    Change("speed of 100 times and more", True, ("tcp_speed",), _scaled("limit_m_s", 1e2, 1e4)),
    Change("rotation of 100 times and more", True, ("tcp_speed",), _scaled("limit_rad_s", 1e2, 1e4)),
    Change("indentation deeper than the tip", True, ("depth",), _scaled("limit_mm", 4.0, 80.0)),
    Change("shear wider than the tip", True, ("shear",), _scaled("limit_mm", 10.0, 100.0)),
    Change("deviation of 100 times and more", True, ("tracking",), _scaled("limit_mm_s", 1e2, 1e4)),
    Change("drift of metres", True, ("standstill",), _scaled("limit_mm", 1e4, 1e6)),
    Change("a deviation that nothing reports", True, ("uncertain",), _scaled("limit_mm", 1e3, 1e5)),
    Change("more frames than a run has", True, ("inconsistent",), _scaled("frames", 1e4, 1e6)),
    Change("box of a kilometre", True, ("workspace",), _walls(1e6, 2e6)),
    Change("arm mistyped", True, ("workspace", "tilt"), _without_a_letter("arm")),
    Change("sensor mistyped", True, ("workspace", "tilt"), _without_a_letter("sensor")),
    Change("state that the task has not", True, ("contact_lost",), _set(states=["setle"])),
    Change("required rule left out", True, _REQUIRED, _leave_out),
    Change("required rule only slows down", True, ("depth",), _set(severity="limit")),
    Change("a little tighter or wider", False, _TIMES, _scaled("limit_ms", 0.9, 1.2)),
    Change("a little tighter or wider", False, ("tcp_speed",), _scaled("limit_m_s", 0.95, 1.2)),
    Change("a little tighter or wider", False, ("depth",), _scaled("limit_mm", 0.97, 1.03)),
    Change("a little tighter or wider", False, ("shear",), _scaled("limit_mm", 0.9, 1.05)),
    Change("a little tighter or wider", False, ("tracking",), _scaled("limit_mm_s", 0.8, 1.25)),
    Change("a little tighter or wider", False, ("tilt",), _scaled("limit_deg", 0.9, 1.1)),
    Change("walls 1 to 10 mm further out", False, ("workspace",), _walls(1.0, 10.0)),
    Change("held half or twice as long", False, ("shear", "tracking", "uncertain"), _scaled("hold_ms", 0.5, 2.0)),
    Change("3 to 15 frames", False, ("inconsistent",), _scaled("frames", 0.6, 3.0)),
    Change("rule that nothing requires left out", False, ("exposure", "shear", "tracking", "limited"), _leave_out),
)


def verdict(data: dict[str, Any], path: Path) -> tuple[bool, str]:
    """Return whether a cell is refused below ``interlocks``, and all that is said of it."""
    path.write_text(yaml.safe_dump(data, sort_keys=False))
    try:
        plan_cell(path)
    except ConfigError as error:
        # Each problem has a line of its own in one message.
        text = str(error)
        return "interlocks" in text, text.replace(str(path), "cell.yaml")
    return False, ""


def run(arguments: Sequence[str], out: Path) -> None:
    """Print both tables; write ``armed.json`` into ``out``."""
    parser = argparse.ArgumentParser(prog="armed", description=__doc__)
    parser.add_argument("--cells", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    chance = random.Random(options.seed)
    shipped = {path.stem: dict(load_layers(path).data) for path in sorted(CONFIGS.glob("*.yaml"))}
    moving = {name: data for name, data in shipped.items() if data.get("interlocks")}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cell.yaml"
        refused = [name for name, data in moving.items() if verdict(data, path)[1]]
        print(f"shipped cells with interlocks: {len(moving)}, refused: {', '.join(refused) or 'none'}")
        tried: Counter[tuple[str, bool]] = Counter()
        right: Counter[tuple[str, bool]] = Counter()
        wrong: list[dict[str, str]] = []
        slowest_s = 0.0
        for _ in range(options.cells):
            name, rule, change, data = _changed(moving, chance)
            started_s = time.process_time()
            is_refused, text = verdict(data, path)
            slowest_s = max(slowest_s, time.process_time() - started_s)
            row = (change.what, change.disarms)
            tried[row] += 1
            if is_refused == change.disarms and bool(text) == change.disarms:
                right[row] += 1
            else:
                wrong.append({"cell": name, "rule": rule, "change": change.what, "answer": text})
    print(f"{'change':<40}{'disarms':>8}{'cells':>7}{'right':>7}")
    for what, disarms in sorted(tried, key=lambda row: (not row[1], row[0])):
        row = (what, disarms)
        print(f"{what:<40}{'yes' if disarms else 'no':>8}{tried[row]:>7}{right[row]:>7}")
    for each in wrong:
        print(f"wrong: {each['cell']}: {each['rule']}: {each['change']}: {each['answer'] or 'accepted'}")
    disarmed = sum(n for (_, disarms), n in tried.items() if disarms)
    caught = sum(n for (_, disarms), n in right.items() if disarms)
    kept = sum(n for (_, disarms), n in right.items() if not disarms)
    print(
        f"refused {caught} of {disarmed} disarmed cells, accepted {kept} of {options.cells - disarmed} others; "
        f"slowest {slowest_s:.2f} s of CPU"
    )
    report = {
        **provenance(),
        "shipped": sorted(moving),
        "shipped_refused": refused,
        "cells": options.cells,
        "disarmed": disarmed,
        "disarmed_refused": caught,
        "armed_accepted": kept,
        "wrong": wrong,
        "slowest_s": slowest_s,
    }
    (out / "armed.json").write_text(json.dumps(report, indent=1) + "\n")


def _changed(cells: dict[str, dict[str, Any]], chance: random.Random) -> tuple[str, str, Change, dict[str, Any]]:
    """Return a shipped cell with one interlock changed: its name, the rule, the change and the whole."""
    while True:
        change = chance.choice(CHANGES)
        name = chance.choice(sorted(cells))
        data = copy.deepcopy(cells[name])
        rules = [rule for rule, entry in data["interlocks"].items() if entry["kind"] in change.kinds]
        if not rules:
            continue
        rule = chance.choice(sorted(rules))
        entry = change.apply(data["interlocks"][rule], chance)
        if entry is None:
            del data["interlocks"][rule]
        else:
            data["interlocks"][rule] = entry
        return name, rule, change, data
