"""Learn a sensor's displacement model and marker matching from its images alone, without labels.

The initial model is the analytic tip of the simulation, swept over contacts and fitted to the sensor's lattice: near
enough to pair most markers of most real frames. The reliably matched frames train a better model of the individual
sensor, which matches the rest.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from touchcell.geometry.types import Array
from touchcell.perception.errors import TrainingError
from touchcell.perception.markers.detection import Discs, rings_of
from touchcell.perception.markers.lattice_fit import fit_lattice
from touchcell.perception.markers.matching import (
    DisplacementModel,
    FirstGuess,
    MarkerField,
    MarkerMatcher,
    disc_density,
    quality,
)
from touchcell.perception.networks.dataset import ProgressCallback
from touchcell.registry import Registry

GRID = 32
GUESS_HIDDEN = 256
_GUESS_BATCH = 128
_CANDIDATES = 60
_BANK = 2000
_MOST_FOR_MATCHING = 40_000
_LAST_STEPS = 100
_SURE = 0.96
_SPREADS = 2
_ALIKE = 8


@dataclass(frozen=True)
class Learned:
    """Result of learning from the frames of a sensor.

    Attributes:
        matcher: for further frames of this sensor.
        guess: its first guess.
        bank: (b, k) its coefficients to try.
        least_score, most_rms_px: its limits.
        fields: matches of all training frames.
    """

    matcher: MarkerMatcher
    guess: FirstGuess
    bank: Array
    least_score: float
    most_rms_px: float
    fields: list[MarkerField]


@dataclass(frozen=True)
class KnownMarkers:
    """Markers of simulated frames.

    Attributes:
        reference: (m, 2) px, the lattice out of contact.
        displacements: (n, m, 2) px from there.
        seen: (n, m) markers that the frame shows.
    """

    reference: Array
    displacements: NDArray[np.floating[Any]]
    seen: NDArray[np.bool_]


def learned_of_known(
    markers: KnownMarkers, image_size: tuple[int, int], *, modes: int, guess_steps: int, seed: int
) -> Learned:
    """Return what ``learn_markers`` would, without fields, from frames whose markers are known.

    Args:
        markers: of the training frames.
        image_size: (height, width) px.
        modes: number of components of the displacement model.
        guess_steps: of the training of the first guess.
        seed: of everything random.
    """
    some = spread(np.arange(len(markers.seen)), _MOST_FOR_MATCHING)
    displacements, seen = markers.displacements[some].astype(np.float64), markers.seen[some]
    model = DisplacementModel.fit(markers.reference, displacements, np.ones_like(seen), modes)
    coefficients = (displacements.reshape(len(seen), -1) - model.mean) @ model.basis.T
    guess = train_guess(model, coefficients, seen, noise_px=0.5, scatter=0.05, steps=guess_steps, seed=seed)
    least_score, most_rms_px = 0.9, 0.2 * model.spacing_px
    bank = _bank(coefficients)
    matcher = MarkerMatcher(model, guess, image_size, bank=bank, least_score=least_score, most_rms_px=most_rms_px)
    return Learned(matcher, guess, bank, least_score, most_rms_px, [])


def spread(indices: NDArray[np.int64], most: int) -> NDArray[np.int64]:
    """Return ``most`` of the indices at most, evenly from among them: contacts of one kind come one after the other."""
    return indices[:: -(-len(indices) // most)]


def find_rings(frames: Sequence[Discs]) -> int:
    """Return the rings of the lattice that explains the discs of some frame best.

    Raises:
        TrainingError: no frame shows a lattice.
    """
    best, rings = math.inf, 0
    for discs in frames[:: max(1, len(frames) // _CANDIDATES)]:
        about = rings_of(len(discs.centres))
        for count in range(max(about - 1, 2), about + 2):
            points, rms = fit_lattice(discs, count)
            spacing = math.sqrt(float(np.ptp(points, axis=0).prod()) / len(points))
            unlike = abs(len(discs.centres) - len(points)) / len(points) + rms / spacing
            if unlike < best:
                best, rings = unlike, count
    if not rings:
        raise TrainingError(
            "no image shows a lattice of rings of markers",
            hint="take images of the tip out of contact, check threshold and crop, or give --rings",
        )
    return rings


def find_reference(frames: Sequence[Discs], rings: int) -> Array:
    """Return the (m, 2) px lattice of the least deformed frame.

    Raises:
        TrainingError: no frame shows a lattice of that many rings.
    """
    step = max(1, len(frames) // _CANDIDATES)
    fits = [fit_lattice(discs, rings) for discs in frames[::step]]
    points, rms = min(fits, key=lambda fit: fit[1])
    if not np.isfinite(rms):
        raise TrainingError(
            f"no image shows a lattice of {rings} rings of markers",
            hint="take images of the tip out of contact, and check threshold, crop and the number of rings",
        )
    return points


@runtime_checkable
class DisplacementPrior(Protocol):
    """Source of the initial displacements, before any image has been matched."""

    def __call__(self, lattice: Array, rings: int, seed: int, /) -> Array:
        """Return (n, m, 2) px displacements of markers in random contacts, from a lattice (m, 2) px and its rings."""
        ...


DISPLACEMENT_PRIORS: Final = Registry("touchcell.displacement_priors", "displacement prior", DisplacementPrior)
"""All installed displacement priors."""


def learn_markers(
    frames: Sequence[Discs],
    image_size: tuple[int, int],
    *,
    rings: int = 10,
    modes: int = 24,
    reference: Array | None = None,
    rounds: int = 2,
    guess_steps: int = 1200,
    seed: int = 0,
    progress: ProgressCallback | None = None,
) -> Learned:
    """Learn to match the frames of one sensor.

    Args:
        frames: discs of each training image; they should cover the contacts that will occur.
        image_size: (height, width) px.
        rings: of the sensor's lattice.
        modes: number of components of the displacement model.
        reference: (m, 2) px lattice out of contact; None finds the least deformed frame.
        rounds: of matching and refitting.
        guess_steps: of the training of the first guess, each round; threefold in the last.
        seed: of everything random.
        progress: called per matched frame.

    Raises:
        TrainingError: there is no such lattice in the frames, or too few of them can be matched.
    """
    needed = max(2 * modes, len(frames) // 4)
    if reference is None:
        reference = find_reference(frames, rings)
    if len(frames) < needed:
        # Known before minutes of matching.
        raise TrainingError(f"{len(frames)} images are too few to learn markers from", hint=f"{needed} are needed")
    displacements = DISPLACEMENT_PRIORS.load("simulated")(reference, rings, seed)
    everything = np.ones(displacements.shape[:2], bool)
    model = DisplacementModel.fit(reference, displacements, everything, modes)
    coefficients = (displacements.reshape(len(displacements), -1) - model.mean) @ model.basis.T
    # The simulated tip is 2.5 px off the real one on average, and its coefficients vary too little.
    guess = train_guess(model, coefficients, everything, noise_px=2.0, scatter=0.15, steps=guess_steps, seed=seed)
    least_score, most_rms_px = 0.9, 0.2 * model.spacing_px
    bank = _bank(coefficients)
    matcher = MarkerMatcher(model, guess, image_size, bank=bank, least_score=least_score, most_rms_px=most_rms_px)
    density = np.stack([guess.density(discs.centres) for discs in frames])
    for number in range(rounds):
        fields = []
        for i, discs in enumerate(frames):
            fields.append(matcher.match(discs))
            if progress is not None:
                progress(number * len(frames) + i + 1, (rounds + 1) * len(frames))
        for _ in range(_SPREADS):
            _spread(matcher, frames, fields, density)
        good = [field for field in fields if _surely(field)]
        if len(good) < needed:
            raise TrainingError(
                f"only {len(good)} of {len(frames)} images could be matched, {needed} are needed",
                hint="check threshold, crop, mask and the number of rings, or give more images",
            )
        if number > 0:
            # In later rounds misfits are outliers rather than errors of a coarse model.
            limit = 3.0 * float(np.median([field.rms_px for field in good]))
            good = [field for field in good if field.rms_px <= limit]
        displacements, seen = stacked(good)
        model = DisplacementModel.fit(reference, displacements, seen, modes)
        coefficients = (displacements.reshape(len(good), -1) - model.mean) @ model.basis.T
        noise_px = float(np.median([field.rms_px for field in good]))
        steps = guess_steps if number + 1 < rounds else 3 * guess_steps
        guess = train_guess(model, coefficients, seen, noise_px=noise_px, scatter=0.05, steps=steps, seed=seed)
        bank = _bank(coefficients)
        matcher = MarkerMatcher(model, guess, image_size, bank=bank, least_score=least_score, most_rms_px=most_rms_px)
    last_round = None if progress is None else lambda i, n: progress(rounds * n + i, (rounds + 1) * n)
    fields = match_all(matcher, frames, last_round)
    _spread(matcher, frames, fields, density)
    return Learned(matcher, guess, bank, least_score, most_rms_px, fields)


def train_guess(
    model: DisplacementModel,
    coefficients: Array,
    seen: NDArray[np.bool_],
    *,
    noise_px: float,
    scatter: float,
    steps: int,
    seed: int,
    hidden: int = GUESS_HIDDEN,
) -> FirstGuess:
    """Train the first guess with fields made from ``coefficients``: mixed, scattered, with markers removed.

    Deep contacts push whole groups of markers together or out of view. A guess trained with markers removed one by one
    was off by half a spacing in 10 % of the validation images, one with markers removed as in the frames in 1 %.

    Args:
        model: its coefficients are estimated.
        coefficients: (n, k) of real or simulated contacts.
        seen: (n, m) their markers that have discs.
        noise_px: of each marker about the model.
        scatter: of the coefficients, relative to their standard deviations.
        steps: of 128 fields each.
        seed: of everything random.
        hidden: units.
    """
    import torch
    from torch import nn

    rng = np.random.default_rng(seed)
    span = np.ptp(model.reference, axis=0).max()
    cell_px = 1.2 * span / GRID
    low = model.reference.mean(axis=0) - 0.6 * span
    k, m = len(model.sd), len(model.reference)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = nn.Sequential(nn.Linear(GRID * GRID, hidden), nn.ReLU(), nn.Linear(hidden, k))
        optimizer = torch.optim.AdamW(network.parameters(), lr=2e-3, weight_decay=1e-3)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 3e-3, total_steps=steps)
        # The modes of large variance decide the matching; the others are fitted after it.
        weights = torch.from_numpy((model.sd / model.sd[0]).astype(np.float32))
        squares: list[NDArray[np.float32]] = []
        # Far contacts are few and hard, so they are oversampled.
        far = 0.5 + ((coefficients / model.sd) ** 2).mean(axis=1)
        often = far / far.sum()
        for _ in range(steps):
            one = rng.choice(len(coefficients), _GUESS_BATCH, p=often)
            other = rng.integers(0, len(coefficients), _GUESS_BATCH)
            share = rng.uniform(-0.2, 0.5, (_GUESS_BATCH, 1)) * (rng.random((_GUESS_BATCH, 1)) < 0.5)
            chosen = coefficients[one] + share * (coefficients[other] - coefficients[one])
            # Unmatched contacts lie beyond the matched ones.
            chosen = rng.uniform(0.8, 1.2, (_GUESS_BATCH, 1)) * chosen
            chosen = chosen + rng.normal(0.0, scatter, chosen.shape) * model.sd
            positions = model.positions(chosen) + rng.normal(0.0, noise_px, (_GUESS_BATCH, m, 2))
            present = (seen[one] & (rng.random((_GUESS_BATCH, m)) < 0.98)).astype(np.float64)
            density = disc_density(positions, present, low, cell_px, GRID)
            aim = torch.from_numpy((chosen / model.sd).astype(np.float32))
            square = (network(torch.from_numpy(density)) - aim).square()
            loss = (weights * square).mean()
            squares.append(square.detach().mean(dim=0).numpy())
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            optimizer.step()
            schedule.step()
    hidden_weight, hidden_bias, weight, bias = (parameter.detach().numpy().copy() for parameter in network.parameters())
    sd = np.sqrt(np.mean(squares[-_LAST_STEPS:], axis=0)) * model.sd
    return FirstGuess(low, float(cell_px), np.ascontiguousarray(hidden_weight.T), hidden_bias, weight, bias, sd)


def match_all(
    matcher: MarkerMatcher, frames: Sequence[Discs], progress: ProgressCallback | None = None
) -> list[MarkerField]:
    """Match every frame from a cold start."""
    fields = []
    for i, discs in enumerate(frames):
        fields.append(matcher.match(discs))
        if progress is not None:
            progress(i + 1, len(frames))
    return fields


def stacked(fields: Sequence[MarkerField]) -> tuple[Array, NDArray[np.bool_]]:
    """Return displacements (n, m, 2) px and seen markers (n, m)."""
    return np.stack([field.displacements for field in fields]), np.stack([field.seen for field in fields])


def _surely(field: MarkerField) -> bool:
    return field.valid and field.score > _SURE


def _spread(
    matcher: MarkerMatcher, frames: Sequence[Discs], fields: list[MarkerField], density: NDArray[np.float32]
) -> None:
    """Match the frames that failed from those that succeeded and are most similar, in place."""
    sure = np.flatnonzero([_surely(field) for field in fields])
    if not len(sure):
        return
    for i, field in enumerate(fields):
        if not _surely(field) and len(frames[i]):
            apart = ((density[sure] - density[i]) ** 2).sum(axis=1)
            similar = sure[np.argsort(apart)[:_ALIKE]]
            again = matcher.match_from(frames[i], [fields[j].coefficients for j in similar])
            fields[i] = max(field, again, key=quality)


def _bank(coefficients: Array) -> Array:
    """Return evenly chosen coefficients, as many as a model file should hold."""
    return coefficients[:: -(-len(coefficients) // _BANK)]
