"""Trials: runs of cell files with some keys changed, anywhere, each kept once it has finished.

A trial is kept as long as nothing that it depends on has changed: its cell file, the files that this names, the code,
and the versions of what computes. One that raises, hangs or is killed becomes a result with its reason.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import time
import traceback
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

import yaml

from touchcell.cell.analysis.code_identity import CodeIdentity, code_identity, digest_of
from touchcell.cell.analysis.run_folder import RunFolder
from touchcell.cell.config.layers import load_layers
from touchcell.cell.config.schema import plan_cell
from touchcell.cell.config.settings import with_settings
from touchcell.cell.config.true_contact import answerable
from touchcell.cell.config.yaml_file import YamlFile
from touchcell.cell.errors import RecordingError
from touchcell.cell.recording.recorder import Recorder
from touchcell.cell.runtime.compose import compose
from touchcell.cell.runtime.loop import RunLoop
from touchcell.cell.runtime.result_record import RESULT, result_record
from touchcell.cell.runtime.run_result import Outcome
from touchcell.errors import ConfigError, TouchcellError, suggest
from touchcell.paths import CONFIGS

COLLECTED: Final = "data"
"""Subfolder of a trial's folder for collected frames."""
LOG: Final = "trial.log"
"""In a trial's folder: what was raised, where something was."""

INVALID: Final = "invalid"
"""Outcome of a trial whose cell cannot be run."""
CRASHED: Final = "crashed"
"""Outcome of a trial that raised."""
LOST: Final = "lost"
"""Outcome of a trial whose process was killed, or took too long."""
BROKEN: Final = frozenset({INVALID, CRASHED, LOST})
"""Outcomes that say nothing of the cell; such a trial is run again by the next call."""


@dataclass(frozen=True, slots=True)
class Trial:
    """One run of an experiment.

    Attributes:
        name: its folder; unique within an experiment.
        row: the row of the table that it belongs to.
        cell: a cell file, among the shipped ones unless it is a path.
        changes: values in place of the file's own, by dotted key ("task.depth_mm").
    """

    name: str
    row: str
    cell: str
    changes: Mapping[str, Any] = field(default_factory=dict)

    def cell_data(self) -> dict[str, Any]:
        """The whole cell file with the changes, without interlocks that ask what its estimators no longer report.

        Files that it names have absolute paths; those in ``changes`` are relative to the working directory.

        Raises:
            ConfigError: the file is invalid, or a key leads nowhere.
        """
        path = Path(self.cell)
        path = path if path.is_absolute() else CONFIGS / path
        file = load_layers(path)
        for key in self.changes:
            _check_way(file.data, key, self.cell)
        changes = {
            key: _with_absolute_paths(None, value, (key.rpartition(".")[2],)) for key, value in self.changes.items()
        }
        data = with_settings(_with_absolute_paths(file, file.data, ()), changes)
        if any(key.endswith(".estimator") for key in changes):
            data["interlocks"] = answerable(data)
        data.pop("sweep", None)
        return data


@dataclass(frozen=True, slots=True)
class Finished:
    """A trial that has ended.

    Attributes:
        trial: the trial.
        folder: its run folder.
        outcome: value of ``touchcell.cell.runtime.loop.Outcome``, or one of ``BROKEN``.
        reason: reason of the outcome.
        measures: named numbers.
        commit: of the code that ran it.
        digest: of that code and of what computes with it.
    """

    trial: Trial
    folder: RunFolder
    outcome: str
    reason: str
    measures: Mapping[str, float]
    commit: str = ""
    digest: str = ""

    @classmethod
    def of(cls, trial: Trial, folder: RunFolder, record: Mapping[str, Any]) -> Finished:
        """Return the result that the content of a ``trial.json`` describes."""
        code = record["code"]
        return cls(
            trial, folder, record["outcome"], record["reason"], record["measures"], code["commit"], code["digest"]
        )

    @property
    def done(self) -> bool:
        """True if the task finished."""
        return self.outcome == Outcome.DONE.value

    @property
    def broken(self) -> bool:
        """True if the trial did not get as far as an outcome of its cell."""
        return self.outcome in BROKEN


@dataclass(frozen=True, slots=True)
class Perform:
    """Runs trials into ``root``; picklable, to be passed to other processes.

    Attributes:
        measure: named numbers of a finished trial.
        root: holds one folder for each trial.
        code: which code runs them.
        keep_stale: keep finished trials of other code, too.
    """

    measure: Callable[[RunFolder], Mapping[str, float]]
    root: Path
    code: CodeIdentity = field(default_factory=code_identity)
    keep_stale: bool = False

    def __call__(self, trial: Trial) -> Finished:
        """Run a trial and measure it; mark it as finished last. What it raises becomes its outcome."""
        return self.run(trial, None)

    def run(self, trial: Trial, data: dict[str, Any] | None) -> Finished:
        """As ``__call__``, of cell file content ``data`` in place of the trial's own."""
        folder = self.root / trial.name
        folder.mkdir(parents=True, exist_ok=True)
        for name in ("trial.json", RESULT, LOG):
            (folder / name).unlink(missing_ok=True)
        try:
            data = trial.cell_data() if data is None else data
            record = self._record(trial, data, folder)
        except ConfigError as error:
            return self.record_broken(trial, INVALID, str(error))
        except RecordingError:
            raise  # The disk is full, or the folder cannot be written: no other trial would do better.
        except Exception as error:
            (folder / LOG).write_text(traceback.format_exc())
            reason = str(error) if isinstance(error, TouchcellError) else f"{type(error).__name__}: {error}"
            return self.record_broken(trial, CRASHED, f"{reason} (see {LOG})")
        # A new RunFolder: the measured one holds its whole recording in memory.
        return Finished.of(trial, RunFolder(folder), record)

    def record_broken(self, trial: Trial, outcome: str, reason: str) -> Finished:
        """Leave a record of a trial that has no result, and return it."""
        folder = self.root / trial.name
        folder.mkdir(parents=True, exist_ok=True)
        record = {"outcome": outcome, "reason": reason, "measures": {}, "code": asdict(self.code)}
        write_whole(folder / "trial.json", json.dumps(record, indent=1))
        return Finished.of(trial, RunFolder(folder), record)

    def kept(self, trial: Trial) -> Finished | None:
        """Return the trial's result from an earlier call, if nothing that it depends on has changed since.

        Raises:
            ConfigError: the trial's cell file is invalid.
        """
        folder = self.root / trial.name
        try:
            record = json.loads((folder / "trial.json").read_text())
        except (OSError, ValueError):
            return None
        # Version 0.1.0 did not record which code ran a trial.
        if record.get("outcome") in BROKEN or "code" not in record:
            return None
        if record["code"]["digest"] != self.code.digest and not self.keep_stale:
            return None
        data = trial.cell_data()
        if record["settings"] != settings_digest(data, file_digests(data)):
            return None
        return Finished.of(trial, RunFolder(folder), record)

    def _record(self, trial: Trial, data: dict[str, Any], folder: Path) -> dict[str, Any]:
        started, cpu_started = time.perf_counter(), time.process_time()
        digests = file_digests(data)
        settings = settings_digest(data, digests)
        if "collect" in data:
            data = {**data, "collect": {**data["collect"], "data": str(folder / COLLECTED)}}
        (folder / "cell.yaml").write_text(yaml.safe_dump(data, sort_keys=False))
        plan = plan_cell(folder / "cell.yaml")
        cell = compose(plan)
        with Recorder(folder / "run.mcap") as recorder, cell:
            result = RunLoop(cell, recorder).run()
        write_whole(folder / RESULT, json.dumps(result_record(plan, result), indent=1))
        measures = self.measure(RunFolder(folder)) if result.cycles else {}
        record = {
            "settings": settings,
            "code": asdict(self.code),
            "files": digests,
            "outcome": result.outcome.value,
            "reason": result.reason,
            "duration_s": result.duration_s,
            "truth": dict(plan.truth),
            "wall_s": round(time.perf_counter() - started, 3),
            "cpu_s": round(time.process_time() - cpu_started, 3),
            # Measures that are not finite are left out, as JSON has no number for them.
            "measures": {name: float(value) for name, value in measures.items() if math.isfinite(value)},
        }
        write_whole(folder / "trial.json", json.dumps(record, indent=1))
        return record


def file_digests(data: Mapping[str, Any]) -> dict[str, str]:
    """Return the digest of each file and folder that a cell file's content names, by its path."""
    return {str(path): digest_of(path) for path in files_named(data)}


def settings_digest(data: Mapping[str, Any], digests: Mapping[str, str]) -> str:
    """Return the digest of a cell file's content and of the files that it names; see ``file_digests``."""
    settings = hashlib.sha256(json.dumps(data, sort_keys=True, default=str).encode())
    for digest in digests.values():
        settings.update(digest.encode())
    return settings.hexdigest()[:16]


def files_named(data: Any) -> list[Path]:
    """Return the files and folders that a cell file's content names by absolute paths, without duplicates."""
    if isinstance(data, Mapping):
        return list(dict.fromkeys(path for value in data.values() for path in files_named(value)))
    if isinstance(data, list | tuple):
        return list(dict.fromkeys(path for value in data for path in files_named(value)))
    return [Path(data)] if isinstance(data, str) and os.path.isabs(data) and os.path.exists(data) else []


_FOLDER_KEYS: Final = frozenset({"data", "folder", "menagerie"})
"""Keys whose value may be the bare name of a folder; other names of files are known by their suffix."""


def _check_way(data: dict[str, Any], key: str, file: str) -> None:
    *way, _ = key.split(".")
    section: Any = data
    for word in way:
        if isinstance(section, list):
            return
        if not isinstance(section.get(word), dict | list):
            raise ConfigError("no such section", file=file, key=key, hint=suggest(word, list(section)))
        section = section[word]


def _with_absolute_paths(file: YamlFile | None, value: Any, at: tuple[str | int, ...]) -> Any:
    if isinstance(value, dict):
        return {key: _with_absolute_paths(file, inner, (*at, key)) for key, inner in value.items()}
    if isinstance(value, list):
        return [_with_absolute_paths(file, inner, (*at, index)) for index, inner in enumerate(value)]
    if isinstance(value, str) and ("." in value or os.sep in value or at[-1] in _FOLDER_KEYS):
        path = (Path() if file is None else file.source(at).parent) / value
        if os.path.exists(path):
            return str(path.absolute())
    return value


def write_whole(path: Path, text: str) -> None:
    """Write a text file and a line end; an interruption leaves the old file. Raises RecordingError."""
    unfinished = path.with_suffix(".unfinished")
    try:
        unfinished.write_text(text + "\n")
        os.replace(unfinished, path)
    except OSError as error:
        raise RecordingError(path, f"cannot be written: {error.strerror}") from None
