"""Checkpoint of an unfinished training: ``NAME.checkpoint.safetensors``, rewritten atomically after every epoch."""

from __future__ import annotations

import json
import os
import tempfile
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from touchcell.perception.errors import TrainingError

_METADATA_KEY = "touchcell_checkpoint"


@dataclass(frozen=True)
class EpochRecord:
    """Results of one epoch.

    Attributes:
        epoch: its number, from 1.
        train_loss: mean over its batches, with dropout and jitter.
        validation_loss: after the epoch, without dropout and jitter.
        mae: mean absolute error on the validation set, by ``labels.CONTACT_NAMES``.
        cpu_s: CPU time of the process, validation included.
    """

    epoch: int
    train_loss: float
    validation_loss: float
    mae: dict[str, float]
    cpu_s: float = field(default=0.0, compare=False)


@dataclass
class Progress:
    """The completed epochs, and the network after the best of them."""

    history: list[EpochRecord] = field(default_factory=list)
    best_epoch: int = 0
    best_loss: float = float("inf")
    best_state: dict[str, Tensor] = field(default_factory=dict)

    @property
    def cpu_s(self) -> float:
        """CPU seconds of all epochs, including those before an interruption."""
        return sum(record.cpu_s for record in self.history)

    def add(self, record: EpochRecord, network: nn.Module) -> None:
        """Add an epoch, and store the network if it is the best so far."""
        self.history.append(record)
        if record.validation_loss < self.best_loss:
            self.best_epoch, self.best_loss = record.epoch, record.validation_loss
            self.best_state = {name: tensor.detach().clone() for name, tensor in network.state_dict().items()}


def checkpoint_path(out: Path) -> Path:
    """Return the path of the checkpoint of the training of ``out``."""
    return out.with_name(f"{out.stem}.checkpoint.safetensors")


def save_checkpoint(
    out: Path,
    recipe: dict[str, Any],
    network: nn.Module,
    average: nn.Module,
    optimizer: torch.optim.Optimizer,
    progress: Progress,
) -> None:
    """Write the state after an epoch atomically."""
    from safetensors.torch import save

    tensors = {f"network.{name}": tensor for name, tensor in network.state_dict().items()}
    tensors |= {f"average.{name}": tensor for name, tensor in average.state_dict().items()}
    tensors |= {f"best.{name}": tensor for name, tensor in progress.best_state.items()}
    for i, state in optimizer.state_dict()["state"].items():
        tensors |= {f"optimizer.{i}.{name}": tensor for name, tensor in state.items()}
    text = json.dumps(
        {
            "recipe": recipe,
            "history": [asdict(record) for record in progress.history],
            "best_epoch": progress.best_epoch,
            "best_loss": progress.best_loss,
        }
    )
    path = checkpoint_path(out)
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=path.parent) as scratch:
        unfinished = Path(scratch) / path.name
        contiguous = {name: tensor.detach().contiguous() for name, tensor in tensors.items()}
        unfinished.write_bytes(save(contiguous, metadata={_METADATA_KEY: text}))
        os.replace(unfinished, path)


def load_checkpoint(
    out: Path, recipe: dict[str, Any], network: nn.Module, average: nn.Module, optimizer: torch.optim.Optimizer
) -> Progress | None:
    """Restore network, average and optimizer from the checkpoint; return None when there is none.

    Raises:
        TrainingError: the checkpoint is damaged, or of a training with other settings.
    """
    from safetensors import SafetensorError, safe_open

    path = checkpoint_path(out)
    if not path.is_file():
        return None
    hint = "delete it, or start again without resuming"
    try:
        with safe_open(path, framework="pt") as stored:
            fields = json.loads((stored.metadata() or {})[_METADATA_KEY])
            tensors = {name: stored.get_tensor(name) for name in stored.keys()}  # noqa: SIM118
    except (SafetensorError, OSError, KeyError, ValueError) as error:
        raise TrainingError(f"{path} cannot be read: {error}", hint=hint) from error
    before, now = fields["recipe"], json.loads(json.dumps(recipe))
    if differing := sorted(key for key in before.keys() | now.keys() if before.get(key) != now.get(key)):
        raise TrainingError(f"{path} is of a training with other {' and '.join(differing)}", hint=hint)

    def part(prefix: str) -> dict[str, Tensor]:
        return {name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)}

    network.load_state_dict(part("network."))
    average.load_state_dict(part("average."))
    state: dict[int, dict[str, Tensor]] = {}
    for name, tensor in part("optimizer.").items():
        index, field_name = name.split(".")
        state.setdefault(int(index), {})[field_name] = tensor
    optimizer.load_state_dict({"state": state, "param_groups": optimizer.state_dict()["param_groups"]})
    return Progress(
        history=[EpochRecord(**record) for record in fields["history"]],
        best_epoch=fields["best_epoch"],
        best_loss=fields["best_loss"],
        best_state=part("best."),
    )


def delete_checkpoint(out: Path) -> None:
    """Remove the checkpoint of a finished training."""
    checkpoint_path(out).unlink(missing_ok=True)
