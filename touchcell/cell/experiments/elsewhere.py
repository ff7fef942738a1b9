"""Trials on workers that share no files with this machine: inputs and results travel by value."""

from __future__ import annotations

import io
import json
import os
import shutil
import tarfile
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from touchcell.cell.analysis.code_identity import CodeIdentity, code_identity
from touchcell.cell.analysis.run_folder import RunFolder
from touchcell.cell.experiments.trials import INVALID, Finished, Perform, Trial, files_named, settings_digest
from touchcell.errors import ConfigError, TouchcellError


class WorkerDiffers(TouchcellError):
    """A worker has other code, or other versions of what computes, than this machine.

    Attributes:
        here: identity of the code of this machine.
        there: identity of the worker's.
    """

    def __init__(self, here: CodeIdentity, there: CodeIdentity) -> None:
        differing = [name for name in here.versions if here.versions[name] != there.versions.get(name)]
        what = ", ".join(f"{name} {there.versions.get(name)} for {here.versions[name]}" for name in differing)
        super().__init__(
            f"a worker has other code: {what or f'commit {there.commit} for {here.commit}'}",
            hint="install the same versions on all workers",
        )
        self.here, self.there = here, there


@dataclass(frozen=True, slots=True)
class Parcel:
    """A trial with all that it reads.

    Attributes:
        trial: the trial.
        data: content of its cell file; empty if that is invalid.
        settings: its digest.
        files: tar archives of the files and folders that it names, by path on the machine that sends them.
        problem: why the cell file is invalid.
    """

    trial: Trial
    data: Mapping[str, Any]
    settings: str
    files: Mapping[str, bytes]
    problem: str = ""


@dataclass(frozen=True, slots=True)
class Delivery:
    """What a trial left: its folder as a tar archive, and which code ran it."""

    folder: bytes
    code: CodeIdentity


@dataclass(frozen=True, slots=True)
class RunElsewhere:
    """Runs parcels in temporary folders; picklable.

    Attributes:
        measure: named numbers of a finished trial.
        code: which code the sender has.
    """

    measure: Callable[[RunFolder], Mapping[str, float]]
    code: CodeIdentity

    def __call__(self, sent: Parcel) -> Delivery:
        """Run a trial, unless the code differs; return its folder."""
        here = code_identity()
        if here.digest != self.code.digest:
            return Delivery(b"", here)
        with tempfile.TemporaryDirectory(prefix="touchcell-") as name:
            folder = Path(name)
            data = dict(sent.data)
            for number, (path, archive) in enumerate(sent.files.items()):
                target = folder / "inputs" / str(number)
                _extract(archive, target)
                data = _replaced(data, path, str(target / os.path.basename(path)))
            perform = Perform(self.measure, folder, here)
            perform.run(sent.trial, data)
            return Delivery(_archive(folder / sent.trial.name), here)


def parcel(trial: Trial) -> Parcel:
    """Return a trial with the bytes of all files that it names."""
    try:
        data = trial.cell_data()
    except ConfigError as error:
        return Parcel(trial, {}, "", {}, str(error))
    files = {str(path): _archive(path, path.name) for path in files_named(data)}
    return Parcel(trial, data, settings_digest(data), files)


def unpack(perform: Perform, trial: Trial, delivery: Delivery) -> Finished:
    """Put a trial's folder where it belongs, and return its result.

    Raises:
        WorkerDiffers: the worker had other code.
    """
    if delivery.code.digest != perform.code.digest:
        raise WorkerDiffers(perform.code, delivery.code)
    folder = perform.root / trial.name
    shutil.rmtree(folder, ignore_errors=True)
    _extract(delivery.folder, folder)
    record = json.loads((folder / "trial.json").read_text())
    if record["outcome"] == INVALID:
        return perform.record_broken(trial, INVALID, record["reason"])
    # The digest is of the files' bytes and of their paths on this machine.
    record["settings"] = settings_digest(trial.cell_data())
    (folder / "trial.json").write_text(json.dumps(record, indent=1) + "\n")
    return Finished(
        trial,
        RunFolder(folder),
        record["outcome"],
        record["reason"],
        record["measures"],
        delivery.code.commit,
        delivery.code.digest,
    )


def _archive(path: Path, name: str = ".") -> bytes:
    content = io.BytesIO()
    with tarfile.open(fileobj=content, mode="w") as archive:
        archive.add(path, name)
    return content.getvalue()


def _extract(content: bytes, folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    with tarfile.open(fileobj=io.BytesIO(content)) as archive:
        archive.extractall(folder, filter="data")


def _replaced(data: Any, old: str, new: str) -> Any:
    if isinstance(data, Mapping):
        return {key: _replaced(value, old, new) for key, value in data.items()}
    if isinstance(data, list | tuple):
        return [_replaced(value, old, new) for value in data]
    return new if data == old else data
