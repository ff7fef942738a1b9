"""Train estimators of many kinds, data sets and seeds on an executor, and compare their errors."""

from __future__ import annotations

import hashlib
import json
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from touchcell.cell.analysis.code_identity import CodeIdentity, code_identity, digest_of
from touchcell.cell.experiments.archives import archive_of, extract
from touchcell.cell.experiments.elsewhere import WorkerDiffers
from touchcell.cell.experiments.executors import EXECUTORS, Lost, Workers
from touchcell.cell.experiments.table import Column, Row, table
from touchcell.cell.experiments.trials import write_whole
from touchcell.errors import ConfigError, TouchcellError
from touchcell.progress import shown_progress

if TYPE_CHECKING:
    from touchcell.perception.networks.checkpoint import EpochRecord

_SPLIT: Final = "val"


@dataclass(frozen=True, slots=True)
class Training:
    """One training.

    Attributes:
        kind: of trainer.
        data: data set.
        seed: of everything random.
        settings: of its kind.
    """

    kind: str
    data: Path
    seed: int
    settings: Mapping[str, Any] = field(default_factory=dict)

    @property
    def row(self) -> str:
        """Name of the row of the table that it belongs to."""
        return f"{self.kind}, {self.data.name}"

    @property
    def name(self) -> str:
        """Name of its model file without ending."""
        return f"{self.kind}_{self.data.name}_{self.seed}"


@dataclass(frozen=True, slots=True)
class Trained:
    """What came of a training.

    Attributes:
        training: the training.
        scores: mean absolute errors and ``nll`` on the validation images; empty if it failed.
        reason: why it failed; empty if it did not.
    """

    training: Training
    scores: Mapping[str, float]
    reason: str = ""


@dataclass(frozen=True, slots=True)
class Parcel:
    """A training with what its worker needs.

    Attributes:
        training: the training.
        folder: for the model, on this machine; None elsewhere.
        archive: of the data set; None on this machine.
        resume: continue what an interrupted training left in ``folder``.
    """

    training: Training
    folder: Path | None
    archive: bytes | None = None
    resume: bool = False


@dataclass(frozen=True, slots=True)
class Delivery:
    """What a worker returns.

    Attributes:
        code: which code the worker has.
        scores: of the trained model.
        archive: of what it wrote, where it did not write it here.
        reason: why the training failed; empty if it did not.
    """

    code: CodeIdentity
    scores: Mapping[str, float] = field(default_factory=dict)
    archive: bytes | None = None
    reason: str = ""


@dataclass(frozen=True, slots=True)
class RunTraining:
    """Trains parcels, each on one thread, so that models do not depend on the number of cores; picklable."""

    code: CodeIdentity

    def __call__(self, sent: Parcel) -> Delivery:
        """Train and evaluate, unless the code differs."""
        here = code_identity()
        if here.digest != self.code.digest:
            return Delivery(here)
        try:
            if sent.folder is not None:
                return Delivery(here, _train(sent.training, sent.folder, sent.resume))
            assert sent.archive is not None
            with tempfile.TemporaryDirectory(prefix="touchcell-") as name:
                data, folder = Path(name) / sent.training.data.name, Path(name) / "model"
                extract(sent.archive, data)
                folder.mkdir()
                return Delivery(here, _train(replace(sent.training, data=data), folder), archive_of(folder))
        except TouchcellError as error:
            return Delivery(here, reason=str(error))


def trainings(
    kinds: Iterable[str], data: Sequence[Path], seeds: Iterable[int], settings: Mapping[str, Any] | None = None
) -> list[Training]:
    """Return all combinations."""
    seeds = list(seeds)
    return [Training(kind, each, seed, dict(settings or {})) for kind in kinds for each in data for seed in seeds]


def train_all(
    wanted: Sequence[Training],
    folder: Path,
    *,
    workers: Workers | None = None,
    executor: str = "local",
    live: bool = False,
) -> list[Trained]:
    """Train what ``folder`` does not hold yet; return all trainings in order, with their errors.

    A model is kept while its data, its settings, the code and PyTorch are the same. One that fails costs no other.

    Args:
        wanted: all trainings.
        folder: for ``NAME.safetensors`` and ``NAME.json`` of each.
        workers: how many at a time, and their limits; one without limits trains in this process.
        executor: name of what runs them, with ``:ADDRESS`` where it takes one.
        live: show progress.

    Raises:
        ConfigError: there is no such executor, or two data sets have one name.
        WorkerDiffers: a worker elsewhere has other code.
        KeyboardInterrupt: finished trainings are kept; begun ones continue from their last epoch on this machine.
    """
    name, _, address = executor.partition(":")
    spec = EXECUTORS.load(name)
    workers = replace(workers or Workers(), address=address)
    _require_names_apart(wanted)
    folder.mkdir(parents=True, exist_ok=True)
    code = code_identity()
    digests = {path: digest_of(path) for path in dict.fromkeys(each.data for each in wanted)}
    records = {each.name: _Record(folder, each.name, _identity(each, digests[each.data], code)) for each in wanted}
    found: dict[str, Trained] = {}
    parcels: list[Parcel] = []
    archives: dict[Path, bytes] = {}
    for each in wanted:
        record = records[each.name]
        kept = record.scores()
        if kept is not None:
            found[each.name] = Trained(each, kept)
        elif spec.shares_files:
            parcels.append(Parcel(each, folder, resume=record.begun()))
            record.write({})
        else:
            if each.data not in archives:
                archives[each.data] = archive_of(each.data)
            parcels.append(Parcel(each, None, archives[each.data]))
    with shown_progress(live=live) as show:
        for index, result in spec.run(RunTraining(code), parcels, workers):
            each = parcels[index].training
            if isinstance(result, Lost):
                found[each.name] = Trained(each, {}, result.reason)
            else:
                if result.code.digest != code.digest:
                    raise WorkerDiffers(code, result.code)
                if result.archive is not None:
                    extract(result.archive, folder)
                if not result.reason:
                    records[each.name].write(result.scores)
                found[each.name] = Trained(each, result.scores, result.reason)
            show("trainings", len(found), len(wanted), each.name)
    return [found[each.name] for each in wanted]


def trainings_table(done: Sequence[Trained]) -> str:
    """Return the errors by kind and data set, mean and spread over the seeds, and why trainings failed."""
    rows: dict[str, list[Trained]] = {}
    for each in done:
        rows.setdefault(each.training.row, []).append(each)
    names = dict.fromkeys(name for each in done for name in each.scores)
    text = table(
        "errors on validation images",
        [
            Row(name, tuple(each.scores for each in members), sum(not each.reason for each in members))
            for name, members in rows.items()
        ],
        [Column(name, name, digits=3) for name in names],
        {},
    )
    failed = [f"{each.training.name}: {each.reason}" for each in done if each.reason]
    return "\n".join([text, *failed])


def _train(training: Training, folder: Path, resume: bool = False) -> dict[str, float]:
    import torch

    from touchcell.perception.networks.evaluate import evaluate
    from touchcell.perception.networks.trainer import train

    torch.set_num_threads(1)
    model = folder / f"{training.name}.safetensors"
    train(
        training.data,
        model,
        kind=training.kind,
        seed=training.seed,
        resume=resume,
        observer=_Silent(),
        settings=training.settings,
    )
    evaluation = evaluate(training.data, _SPLIT, model)
    return {**evaluation.mae, "nll": evaluation.nll}


class _Silent:
    """Observer of a training that shows nothing."""

    def images(self, split: str, done: int, total: int) -> None:
        """See ``Observer``."""

    def batch(self, epoch: int, epochs: int, done: int, total: int, loss: float) -> None:
        """See ``Observer``."""

    def epoch(self, record: EpochRecord, *, best: bool) -> None:
        """See ``Observer``."""


def _identity(training: Training, data_digest: str, code: CodeIdentity) -> str:
    content = json.dumps([training.kind, training.seed, training.settings, data_digest, code.digest, _torch()])
    return hashlib.sha256(content.encode()).hexdigest()[:16]


def _torch() -> str:
    try:
        return version("torch")
    except PackageNotFoundError:
        return "-"


def _require_names_apart(wanted: Sequence[Training]) -> None:
    paths: dict[str, Path] = {}
    for each in wanted:
        other = paths.setdefault(each.data.name, each.data)
        if other != each.data:
            raise ConfigError(
                f"two data sets are called {each.data.name}",
                key="--data",
                value=f"{other}, {each.data}",
                hint="models are named by kind, data set and seed: rename one of the folders",
            )


@dataclass(frozen=True, slots=True)
class _Record:
    """``NAME.json`` beside a model: what the training depended on, and its scores once it has ended."""

    folder: Path
    name: str
    identity: str

    def begun(self) -> bool:
        """Return whether an earlier training of the same identity began here."""
        return self._content().get("identity") == self.identity

    def scores(self) -> dict[str, float] | None:
        """Return the scores of an earlier training of the same identity that ended; None without one."""
        done = self.begun() and (self.folder / f"{self.name}.safetensors").exists()
        scores: dict[str, float] | None = self._content().get("scores") if done else None
        return scores or None

    def write(self, scores: Mapping[str, float]) -> None:
        """Write the file whole. Raises RecordingError."""
        code = asdict(code_identity()) | {"torch": _torch()}
        record = {"identity": self.identity, "scores": dict(scores), "code": code}
        write_whole(self.folder / f"{self.name}.json", json.dumps(record, indent=1))

    def _content(self) -> dict[str, Any]:
        try:
            content = json.loads((self.folder / f"{self.name}.json").read_text())
        except (OSError, ValueError):
            return {}
        return content if isinstance(content, dict) else {}
