"""Train an estimator of any kind, and entry points of trainers (group ``touchcell.trainers``)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Generic, TypeAlias, TypeVar

from pydantic import ValidationError

from touchcell.errors import suggest
from touchcell.perception.errors import TrainingError
from touchcell.plugin_section import Section
from touchcell.registry import Registry

if TYPE_CHECKING:
    from touchcell.perception.networks.progress import Observer


@dataclass(frozen=True, slots=True)
class TrainingJob:
    """What every training has besides the settings of its kind.

    Attributes:
        data: data set, see ``touchcell.drivers.replay.dataset``.
        out: model file to write, ``NAME.safetensors``; other files are written beside it.
        observer: receives the progress.
        seed: of everything random; the same seed on the same machine gives the same model.
        resume: continue an interrupted training; False starts again.
        cache: folder for preprocessed images; None for ``dataset.default_cache()``.
    """

    data: Path
    out: Path
    observer: Observer
    seed: int = 0
    resume: bool = True
    cache: Path | None = None


SettingsT = TypeVar("SettingsT", bound=Section)


@dataclass(frozen=True, slots=True)
class TrainerSpec(Generic[SettingsT]):
    """Entry point of one trainer. Its module imports no training library: that happens in ``train``.

    Attributes:
        name: value of ``--kind``.
        summary: one line for ``touchcell list``.
        config: pydantic model of its settings; every one has a default.
        train: trains and writes the model file. Raises DataError or TrainingError.
    """

    name: str
    summary: str
    config: type[SettingsT]
    train: Callable[[SettingsT, TrainingJob], object]


AnyTrainer: TypeAlias = TrainerSpec[Any]
"""A trainer that was found by name: its settings are what its own model validates."""

TRAINERS: Final[Registry[AnyTrainer]] = Registry("touchcell.trainers", "trainer", TrainerSpec)
"""All installed trainers."""


def train(
    data: Path,
    out: Path,
    *,
    kind: str = "gdn",
    seed: int = 0,
    resume: bool = True,
    cache: Path | None = None,
    observer: Observer | None = None,
    settings: Mapping[str, object] | None = None,
) -> None:
    """Train on ``data/train``, select by ``data/val``, and write the model file ``out`` with figures beside it.

    An interrupted training continues from its last complete epoch when the same call is made again, and ends in the
    same model as an uninterrupted one.

    Args:
        data: data set, see ``touchcell.drivers.replay.dataset``; its image out of contact, where it has one, is stored
            for the contact gate.
        out: ``NAME.safetensors``; figures become ``NAME_predictions.png`` and ``NAME_curves.png``.
        kind: which trainer: gdn predicts a Gaussian, cnn means alone, markers as ``marker_training``.
        seed: of everything random; the same seed on the same machine gives the same file, except for the time it took.
        resume: continue an interrupted training; False starts again.
        cache: folder for preprocessed images; None for ``dataset.default_cache()``.
        observer: receives the progress; None shows it on the terminal.
        settings: of this kind, such as ``epochs``; ``touchcell describe trainer KIND`` lists them. None for defaults.

    Raises:
        ConfigError: there is no such trainer.
        DataError: the data set is damaged.
        TrainingError: a setting is unknown or out of its limits, the labels cannot be learned, the loss is not finite,
            the training diverged, or the interrupted training had other settings or data.
    """
    spec = TRAINERS.load(kind)
    config = _settings(spec, settings or {})
    if observer is not None:
        spec.train(config, TrainingJob(data, out, observer, seed, resume, cache))
        return
    from touchcell.perception.networks.progress import Display

    with Display() as display:
        spec.train(config, TrainingJob(data, out, display, seed, resume, cache))


def _settings(spec: AnyTrainer, settings: Mapping[str, object]) -> Section:
    try:
        validated: Section = spec.config.model_validate(settings)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, first["loc"]))
        if first["type"] == "extra_forbidden":
            known = tuple(spec.config.model_fields)
            hint = suggest(key, known, otherwise=f"settings of {spec.name}")
            raise TrainingError(f"kind {spec.name} has no setting {key}", hint=hint) from error
        hint = f"`touchcell describe trainer {spec.name}` lists limits"
        raise TrainingError(f"{key} {first['input']!r}: {first['msg']}", hint=hint) from error
    return validated
