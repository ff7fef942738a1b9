"""End of every training: calibrate the sigmas on the validation set, write the model file and two figures."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchcell.geometry.types import Array, ImageArray
from touchcell.perception.models.architecture_spec import ArchitectureConfig
from touchcell.perception.models.labels import contact_from_xi
from touchcell.perception.models.model_file import Header, Labels, Model, save_model, touchcell_version
from touchcell.perception.models.preprocessing import Preprocessing
from touchcell.perception.networks.checkpoint import Progress, delete_checkpoint
from touchcell.perception.networks.figures import write_curves, write_predictions
from touchcell.perception.networks.sigma_scaling import calibration


def write_trained(
    out: Path,
    *,
    architecture: ArchitectureConfig,
    preprocessing: Preprocessing,
    labels: Labels,
    tensors: dict[str, NDArray[np.float32]],
    reference: ImageArray | None,
    training_data: str,
    metadata: Mapping[str, Any],
    progress: Progress,
    mean: Array,
    sigma: Array,
    validation_xi: Array,
) -> Model:
    """Write the model file ``out``, ``NAME_predictions.png`` and ``NAME_curves.png``, and remove the checkpoint.

    Args:
        out: ``NAME.safetensors``.
        architecture, preprocessing, labels, tensors, reference, training_data: of the model, see ``model_file``.
        metadata: settings and counts for the header; the results are added.
        progress: of the training.
        mean, sigma: (n, 6) of the validation set, in label half-ranges, uncalibrated.
        validation_xi: (n, 6) its labels, m and rad.
    """
    targets = labels.targets(validation_xi)
    best = progress.history[progress.best_epoch - 1]
    model = Model(
        Header(
            touchcell_version=touchcell_version(),
            architecture=architecture,
            preprocessing=preprocessing,
            labels=labels,
            **calibration(labels, mean, sigma, targets),
            training_data=training_data,
            training={
                **{key: list(value) if isinstance(value, tuple) else value for key, value in metadata.items()},
                "epochs_run": len(progress.history),
                "best_epoch": progress.best_epoch,
                "epochs_cpu_s": round(progress.cpu_s, 1),
                "validation_loss": progress.best_loss,
                "validation_mae": list(best.mae.values()),
            },
        ),
        tensors,
        reference,
    )
    save_model(model, out)
    xi, covariance = labels.xi_gaussian(mean, model.header.calibrated(sigma, mean))
    write_predictions(
        out.with_name(f"{out.stem}_predictions.png"),
        truth=contact_from_xi(validation_xi),
        predicted=contact_from_xi(xi),
        sigma=np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)),
    )
    write_curves(out.with_name(f"{out.stem}_curves.png"), progress.history)
    delete_checkpoint(out)
    return model
