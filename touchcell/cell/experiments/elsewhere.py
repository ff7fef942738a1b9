"""Trials on workers that share no files with this machine: inputs and results travel by value."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from touchcell.cell.analysis.code_identity import CodeIdentity, code_identity
from touchcell.cell.analysis.run_folder import RunFolder
from touchcell.cell.experiments.archives import archive_of, extract
from touchcell.cell.experiments.trials import Finished, Perform, Trial, file_digests, files_named, settings_digest
from touchcell.errors import TouchcellError


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
        data: content of its cell file.
        files: tar archives of the files and folders that it names, by path on the machine that sends them.
        digests: of these files.
    """

    trial: Trial
    data: Mapping[str, Any]
    files: Mapping[str, bytes]
    digests: Mapping[str, str]


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
                extract(archive, target)
                data = _replaced(data, path, str(target / os.path.basename(path)))
            perform = Perform(self.measure, folder, here)
            perform.run(sent.trial, data)
            return Delivery(archive_of(folder / sent.trial.name), here)


def parcel(trial: Trial) -> Parcel:
    """Return a trial with the bytes of all files that it names. Raises ConfigError if its cell file is invalid."""
    data = trial.cell_data()
    files = {str(path): archive_of(path, path.name) for path in files_named(data)}
    return Parcel(trial, data, files, file_digests(data))


def unpack(perform: Perform, sent: Parcel, delivery: Delivery) -> Finished:
    """Put a trial's folder where it belongs, and return its result.

    Raises:
        WorkerDiffers: the worker had other code.
    """
    if delivery.code.digest != perform.code.digest:
        raise WorkerDiffers(perform.code, delivery.code)
    folder = perform.root / sent.trial.name
    shutil.rmtree(folder, ignore_errors=True)
    extract(delivery.folder, folder)
    record = json.loads((folder / "trial.json").read_text())
    # The worker's paths are gone with its temporary folder; files are found again by those of this machine.
    record |= {"settings": settings_digest(sent.data, sent.digests), "files": dict(sent.digests)}
    (folder / "trial.json").write_text(json.dumps(record, indent=1) + "\n")
    return Finished.of(sent.trial, RunFolder(folder), record)


def _replaced(data: Any, old: str, new: str) -> Any:
    if isinstance(data, Mapping):
        return {key: _replaced(value, old, new) for key, value in data.items()}
    if isinstance(data, list | tuple):
        return [_replaced(value, old, new) for value in data]
    return new if data == old else data
