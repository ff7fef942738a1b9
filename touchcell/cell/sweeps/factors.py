"""Factors of a sweep: keys of a cell file with the values that they take, on a grid or sampled."""

from __future__ import annotations

import hashlib
import itertools
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from touchcell.cell.config.yaml_file import parse_value
from touchcell.errors import ConfigError

_NUMBER: Final = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_LINEAR: Final = re.compile(rf"({_NUMBER}):({_NUMBER}):(\d+)")
_WHOLE: Final = re.compile(r"(-?\d+)\.\.(-?\d+)")
_DRAWN: Final = re.compile(r"(uniform|loguniform|normal|choice)\((.*)\)")
_FORMS: Final = "FIRST:LAST:COUNT, FIRST..LAST (whole numbers), or values with commas between"
_SAMPLED: Final = "uniform(LOW, HIGH), loguniform(LOW, HIGH), normal(MEAN, SD), choice(A, B), or FIRST..LAST"
_MOST: Final = 1_000_000


@dataclass(frozen=True, slots=True)
class Distribution:
    """Values drawn at random.

    Attributes:
        kind: "uniform", "loguniform", "normal" or "choice".
        parameters: low and high; mean and standard deviation; or the values to choose from.
    """

    kind: str
    parameters: tuple[Any, ...]

    def draw(self, rng: np.random.Generator) -> Any:
        """Return one value."""
        if self.kind == "choice":
            return self.parameters[int(rng.integers(len(self.parameters)))]
        first, second = self.parameters
        if self.kind == "uniform":
            return float(rng.uniform(first, second))
        if self.kind == "loguniform":
            return math.exp(float(rng.uniform(math.log(first), math.log(second))))
        return float(rng.normal(first, second))


@dataclass(frozen=True, slots=True)
class Factors:
    """Every combination of ``grid``, each with every one of ``samples`` draws of ``sampled``.

    The n-th draw of a key is the same at every point of the grid, so that points differ by the grid alone.

    Attributes:
        grid: values by dotted key.
        sampled: values in turn, or a distribution, by dotted key.
        samples: draws at each point of the grid.
        seed: of the draws.
    """

    grid: Mapping[str, tuple[Any, ...]]
    sampled: Mapping[str, tuple[Any, ...] | Distribution]
    samples: int = 1
    seed: int = 0

    @property
    def keys(self) -> tuple[str, ...]:
        """All keys that change."""
        return (*self.grid, *self.sampled)

    def __len__(self) -> int:
        return math.prod(len(values) for values in self.grid.values()) * self.samples

    def points(self) -> Iterator[tuple[dict[str, Any], dict[str, Any]]]:
        """Yield the settings of each trial: those of its point of the grid, and the sampled ones."""
        draws = [self._draw(number) for number in range(self.samples)]
        for values in itertools.product(*self.grid.values()):
            for draw in draws:
                yield dict(zip(self.grid, values, strict=True)), draw

    def _draw(self, number: int) -> dict[str, Any]:
        found = {}
        for key, values in self.sampled.items():
            if isinstance(values, Distribution):
                key_seed = int.from_bytes(hashlib.sha256(key.encode()).digest()[:8], "big")
                found[key] = values.draw(np.random.default_rng([self.seed, key_seed, number]))
            else:
                found[key] = values[number]
        return found


def grid_values(key: str, value: Any) -> tuple[Any, ...]:
    """Return the values of ``--grid KEY=VALUE``: a range, several whole numbers, or a list.

    Raises:
        ConfigError: it is none of these.
    """
    if isinstance(value, Sequence) and not isinstance(value, str):
        return _some(key, value, tuple(value))
    text = str(value).strip()
    if (found := _LINEAR.fullmatch(text)) is not None:
        count = _count(key, text, int(found[3]))
        first, last = float(found[1]), float(found[2])
        return tuple(_tidy(each) for each in np.linspace(first, last, count))
    if (found := _WHOLE.fullmatch(text)) is not None:
        return _whole(key, text, int(found[1]), int(found[2]))
    return _some(key, text, tuple(_parsed(key, part) for part in _split(text)))


def sampled_values(key: str, value: Any) -> tuple[Any, ...] | Distribution:
    """Return what ``--sample KEY=VALUE`` draws from.

    Raises:
        ConfigError: it is no distribution and no range of whole numbers.
    """
    text = str(value).strip()
    if (found := _WHOLE.fullmatch(text)) is not None:
        return _whole(key, text, int(found[1]), int(found[2]))
    found = _DRAWN.fullmatch(text)
    if found is None:
        raise ConfigError("draws from nothing known", key=key, value=text, hint=_SAMPLED)
    kind, parameters = found[1], tuple(_parsed(key, part) for part in _split(found[2]))
    if kind == "choice":
        return Distribution(kind, _some(key, text, parameters))
    if len(parameters) != 2 or not all(_is_number(each) for each in parameters):
        raise ConfigError(f"{kind} takes two numbers", key=key, value=text, hint=_SAMPLED)
    first, second = parameters
    if kind == "normal" and second < 0.0:
        raise ConfigError("the standard deviation is negative", key=key, value=text, hint=_SAMPLED)
    if kind != "normal" and not first <= second:
        raise ConfigError("its lower end is above its upper one", key=key, value=text, hint=_SAMPLED)
    if kind == "loguniform" and first <= 0.0:
        raise ConfigError("a logarithm needs ends above zero", key=key, value=text, hint=_SAMPLED)
    return Distribution(kind, (float(first), float(second)))


def make_factors(grid: Mapping[str, Any], sample: Mapping[str, Any], samples: int | None, seed: int = 0) -> Factors:
    """Return the factors of a sweep from the text of its options, or from a file.

    Args:
        grid: text or lists by key.
        sample: text by key.
        samples: draws at each point of the grid; None for the length of the ranges in ``sample``, or one.
        seed: of the draws.

    Raises:
        ConfigError: a value is invalid, a key stands in both, ranges differ in length, or the trials are too many.
    """
    if both := sorted(set(grid) & set(sample)):
        raise ConfigError("is both on the grid and sampled", key=both[0], hint="keep one of them")
    values = {key: grid_values(key, value) for key, value in grid.items()}
    sampled = {key: sampled_values(key, value) for key, value in sample.items()}
    lengths = {key: len(each) for key, each in sampled.items() if not isinstance(each, Distribution)}
    number = samples if samples is not None else min(lengths.values(), default=1)
    for key, length in lengths.items():
        if length < number or (samples is None and length != number):
            raise ConfigError(
                f"has {length} values for {number} samples", key=key, value=sample[key], hint="make them as many"
            )
    factors = Factors(values, sampled, number, seed)
    if len(factors) > _MOST:
        raise ConfigError(f"asks for {len(factors)} trials", hint=f"at most {_MOST}")
    return factors


def _whole(key: str, text: str, first: int, last: int) -> tuple[Any, ...]:
    _count(key, text, last - first + 1)
    return tuple(range(first, last + 1))


def _count(key: str, text: str, count: int) -> int:
    if not 1 <= count <= _MOST:
        raise ConfigError(f"has {count} values", key=key, value=text, hint=f"from 1 to {_MOST}")
    return count


def _some(key: str, value: Any, values: tuple[Any, ...]) -> tuple[Any, ...]:
    if not values or any(each is None for each in values):
        raise ConfigError("has a value that is empty", key=key, value=value, hint=_FORMS)
    return values


def _parsed(key: str, text: str) -> Any:
    try:
        return parse_value(text)
    except ConfigError as error:
        raise ConfigError(error.reason, key=key, value=text, hint=error.hint) from None


def _split(text: str) -> list[str]:
    """Return the parts of ``text`` between commas that stand in no brackets."""
    parts, depth = [""], 0
    for letter in text:
        depth += (letter in "[{(") - (letter in "]})")
        if letter == "," and depth == 0:
            parts.append("")
        else:
            parts[-1] += letter
    return [part.strip() for part in parts]


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _tidy(value: float) -> int | float:
    """Return whole numbers as such: some keys take no others."""
    rounded = round(float(value), 12)
    return int(rounded) if rounded.is_integer() else rounded
