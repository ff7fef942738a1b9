"""Commands as callers hand them over, as values of our own: finite float64 copies, or refused.

NumPy takes almost anything for an array and raises almost anything for the rest. Here every such case ends in
``CommandRejected``, and what passes shares no memory with the caller.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Sequence
from typing import Any

import numpy as np

from touchcell.drivers.core.commands import TwistCommand, TwistFrame, is_immutable, read_only
from touchcell.drivers.core.errors import CommandRejected, Rejection
from touchcell.geometry.finite import all_finite
from touchcell.geometry.types import Array

_SIX = (6,)
_FLOAT64 = np.dtype(np.float64)
_REAL_KINDS = "fiu"


def finite_array(device: str, what: str, value: Any, shape: Sequence[int]) -> Array:
    """A read-only float64 copy of ``value`` with that ``shape``.

    Real and integer arrays of any width and layout, and sequences of numbers, are taken. Text, booleans, complex
    numbers, objects and arrays with masked elements are refused: what they would become is not what was meant.

    Args:
        device: name for errors.
        what: the value's name in messages.
        value: as the caller gave it.
        shape: that it must have.

    Raises:
        CommandRejected: NON_FINITE or SHAPE, in that order.
    """
    if type(value) is np.ndarray and value.dtype == _FLOAT64 and value.shape == shape:
        array = value
    else:
        array = _as_float64(device, what, value)
    # From here on in memory of its own: it cannot change between check and use.
    if not is_immutable(array):
        array = read_only(array)
    if not all_finite(array):
        raise CommandRejected(device, Rejection.NON_FINITE, f"{what} is not finite", value=array)
    if array.shape != tuple(shape):
        raise CommandRejected(
            device,
            Rejection.SHAPE,
            f"{what} has shape {array.shape}, not {tuple(shape)}",
            value=array.shape,
            limit=tuple(shape),
        )
    return array


def _as_float64(device: str, what: str, value: Any) -> Array:
    try:
        masked = np.ma.is_masked(value)
        raw = np.asarray(value)
        array: Array | None = raw.astype(np.float64) if raw.dtype.kind in _REAL_KINDS else None
    except Exception as error:
        raise CommandRejected(device, Rejection.SHAPE, f"{what} is no array of numbers: {error}") from None
    if array is None:
        raise CommandRejected(device, Rejection.SHAPE, f"{what} is an array of {raw.dtype}, not of numbers")
    if masked:
        raise CommandRejected(device, Rejection.NON_FINITE, f"{what} has masked elements")
    return array


def finite_number(device: str, what: str, value: Any) -> float:
    """``value`` as a float. Raises CommandRejected(NON_FINITE) for what is no finite number."""
    try:
        if math.isfinite(value):
            return float(value)
    except Exception as error:
        reason = f"{what} is no number: {error}"
    else:
        reason = f"{what} is not finite"
    raise CommandRejected(device, Rejection.NON_FINITE, reason, value=value)


def checked_twist_command(device: str, command: TwistCommand) -> TwistCommand:
    """``command`` with values of its own: a finite read-only twist (6,), a finite time-to-live, a known frame, a stamp.

    Raises:
        CommandRejected: NON_FINITE, SHAPE, FRAME or, without a time stamp, EXPIRED, in that order.
    """
    ttl_s = finite_number(device, "time-to-live", command.ttl_s)
    twist = finite_array(device, "twist", command.twist, _SIX)
    if not isinstance(command.frame, TwistFrame):
        raise CommandRejected(device, Rejection.FRAME, f"unknown frame {command.frame!r}", value=command.frame)
    try:
        t_ns = operator.index(command.t_ns)
    except TypeError:
        reason = f"time stamp {command.t_ns!r} is no whole number of nanoseconds"
        raise CommandRejected(device, Rejection.EXPIRED, reason, value=command.t_ns) from None
    if twist is command.twist and t_ns is command.t_ns and ttl_s is command.ttl_s and type(command) is TwistCommand:
        return command
    return TwistCommand(twist, command.frame, t_ns, ttl_s, command.t_cause_ns)
