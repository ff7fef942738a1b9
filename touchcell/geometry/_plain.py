"""SE(3) kernels in Python and numpy: the reference for the compiled ones, and the fallback where those are not built.

Each kernel takes the entries of its argument and returns the entries of its result, row by row. An entry is a Python
float for one element and a column for a batch, so one formula serves both.

With s = theta^2, W the matrix of w x and V that of v x, everything is built from smooth functions of s:

    A = sin(theta)/theta           B = (1 - cos(theta))/s        C = (1 - A)/s
    E = (2B - A)/s = -2 dB/ds      F = (3C - B)/s = -2 dC/ds
    D = (1 - A/2B)/s               G = 2 dD/ds

    R = I + A W + B W^2            J = I + B W + C W^2           J^-1 = I - W/2 + D W^2

Below 1 rad they are summed as series, where the closed forms would cancel; above, from the half angle. The upper right
block of the 6x6 Jacobians is the derivative of the 3x3 one along v, because ad(xi) = [[W, V], [0, W]] is the dual
number W + eps V and J a power series in it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from math import factorial
from types import ModuleType
from typing import Any, TypeAlias

import numpy as np

from touchcell.geometry import _check
from touchcell.geometry.types import Array, ArrayLike

Entry: TypeAlias = Any
"""A float, or a float64 column."""

Formula: TypeAlias = Callable[..., tuple[Entry, ...]]
"""A kernel: maps the entries of its argument to the entries of its result."""

TERMS = 9
SERIES_A = [(-1) ** k / factorial(2 * k + 1) for k in range(TERMS)]
SERIES_B = [(-1) ** k / factorial(2 * k + 2) for k in range(TERMS)]
SERIES_C = [(-1) ** k / factorial(2 * k + 3) for k in range(TERMS)]
SERIES_E = [(-1) ** k * (2 * k + 2) / factorial(2 * k + 4) for k in range(TERMS)]
SERIES_F = [(-1) ** k * (2 * k + 2) / factorial(2 * k + 5) for k in range(TERMS)]
SERIES_D = [  # |Bernoulli number 2k + 2| / (2k + 2)!
    1 / 12,
    1 / 720,
    1 / 30240,
    1 / 1209600,
    1 / 47900160,
    691 / 1307674368000,
    1 / 74724249600,
    3617 / 10670622842880000,
    43867 / 5109094217170944000,
    174611 / 802857662698291200000,
]
SERIES_G = [2 * k * d for k, d in enumerate(SERIES_D)][1:]


def exp(xi: ArrayLike) -> Array:
    return _apply(_exp, _check.twist("exp", "xi", xi), 1, (4, 4))


def log(T: ArrayLike) -> Array:
    return _apply(_log, _check.pose("log", "T", T), 2, (6,))


def inverse(T: ArrayLike) -> Array:
    return _apply(_inverse, _check.pose("inverse", "T", T), 2, (4, 4))


def adjoint(T: ArrayLike) -> Array:
    return _apply(_adjoint, _check.pose("adjoint", "T", T), 2, (6, 6))


def from_euler_mm_deg(pose: ArrayLike) -> Array:
    pose = _check.twist("from_euler_mm_deg", "pose", pose)
    angles = np.radians(pose[..., 3:])
    sines, cosines = np.sin(angles), np.cos(angles)
    sa, sb, sc = sines[..., 0], sines[..., 1], sines[..., 2]
    ca, cb, cc = cosines[..., 0], cosines[..., 1], cosines[..., 2]
    T = np.zeros((*pose.shape[:-1], 4, 4))
    T[..., 0, 0], T[..., 0, 1], T[..., 0, 2] = cc * cb, cc * sb * sa - sc * ca, cc * sb * ca + sc * sa
    T[..., 1, 0], T[..., 1, 1], T[..., 1, 2] = sc * cb, sc * sb * sa + cc * ca, sc * sb * ca - cc * sa
    T[..., 2, 0], T[..., 2, 1], T[..., 2, 2] = -sb, cb * sa, cb * ca
    T[..., :3, 3] = pose[..., :3] * 1e-3
    T[..., 3, 3] = 1.0
    return T


def to_euler_mm_deg(T: ArrayLike) -> Array:
    T = _check.pose("to_euler_mm_deg", "T", T)
    R = T[..., :3, :3]
    gamma = np.arctan2(R[..., 1, 0], R[..., 0, 0])
    sine, cosine = np.sin(gamma), np.cos(gamma)
    out = np.empty((*T.shape[:-2], 6))
    out[..., :3] = T[..., :3, 3] * 1e3
    out[..., 3] = np.arctan2(sine * R[..., 0, 2] - cosine * R[..., 1, 2], cosine * R[..., 1, 1] - sine * R[..., 0, 1])
    out[..., 4] = np.arctan2(-R[..., 2, 0], np.hypot(R[..., 0, 0], R[..., 1, 0]))
    out[..., 5] = gamma
    np.degrees(out[..., 3:], out=out[..., 3:])
    out += 0.0  # turns -0.0 into 0.0
    return out


def left_jacobian(xi: ArrayLike) -> Array:
    return _apply(_left_jacobian, _check.twist("left_jacobian", "xi", xi), 1, (6, 6))


def left_jacobian_inverse(xi: ArrayLike) -> Array:
    return _apply(_left_jacobian_inverse, _check.twist("left_jacobian_inverse", "xi", xi), 1, (6, 6))


def compose(T_a_b: ArrayLike, T_b_c: ArrayLike) -> Array:
    left, right = _check.pose_pair("compose", "T_a_b", T_a_b, "T_b_c", T_b_c)
    product = left @ right
    product[..., 3, :] = (0.0, 0.0, 0.0, 1.0)
    return product


def _apply(kernel: Formula, array: Array, core_ndim: int, core: tuple[int, ...]) -> Array:
    """Run ``kernel`` on one element as floats, or on a batch as columns."""
    leading = array.shape[: array.ndim - core_ndim]
    if not leading:
        return np.array(kernel(*array.ravel().tolist())).reshape(core)
    count = math.prod(leading)
    out = np.empty((count, math.prod(core)))
    columns = array.reshape(count, math.prod(array.shape[len(leading) :])).T.copy()
    for index, entry in enumerate(kernel(*columns)):
        out[:, index] = entry
    return out.reshape(leading + core)


def _exp(x: Entry, y: Entry, z: Entry, a: Entry, b: Entry, c: Entry) -> tuple[Entry, ...]:
    A, B, C = _branch(a * a + b * b + c * c, _series_abc, _closed_abc)
    # p = w x v, q = w x p
    p0, p1, p2 = b * z - c * y, c * x - a * z, a * y - b * x
    q0, q1, q2 = b * p2 - c * p1, c * p0 - a * p2, a * p1 - b * p0
    Bab, Bac, Bbc = B * a * b, B * a * c, B * b * c
    Aa, Ab, Ac = A * a, A * b, A * c
    return (
        *(1.0 - B * (b * b + c * c), Bab - Ac, Bac + Ab, x + B * p0 + C * q0),
        *(Bab + Ac, 1.0 - B * (a * a + c * c), Bbc - Aa, y + B * p1 + C * q1),
        *(Bac - Ab, Bbc + Aa, 1.0 - B * (a * a + b * b), z + B * p2 + C * q2),
        *(0.0, 0.0, 0.0, 1.0),
    )


def _log(*T: Entry) -> tuple[Entry, ...]:
    r00, r01, r02, x, r10, r11, r12, y, r20, r21, r22, z, _, _, _, _ = T
    quaternion = _quaternion if isinstance(x, float) else _quaternion_columns
    qw, qx, qy, qz = quaternion(r00, r01, r02, r10, r11, r12, r20, r21, r22)
    scale, cot = _angle_per_sine(qw, qx * qx + qy * qy + qz * qz)
    a, b, c = scale * qx, scale * qy, scale * qz
    s = a * a + b * b + c * c
    (D,) = _branch(s, _series_d, _closed_d, cot)
    p0, p1, p2 = b * z - c * y, c * x - a * z, a * y - b * x
    return (
        x - 0.5 * p0 + D * (b * p2 - c * p1),
        y - 0.5 * p1 + D * (c * p0 - a * p2),
        z - 0.5 * p2 + D * (a * p1 - b * p0),
        *(a, b, c),
    )


def _inverse(*T: Entry) -> tuple[Entry, ...]:
    r00, r01, r02, x, r10, r11, r12, y, r20, r21, r22, z, _, _, _, _ = T
    return (
        *(r00, r10, r20, -(r00 * x + r10 * y + r20 * z)),
        *(r01, r11, r21, -(r01 * x + r11 * y + r21 * z)),
        *(r02, r12, r22, -(r02 * x + r12 * y + r22 * z)),
        *(0.0, 0.0, 0.0, 1.0),
    )


def _adjoint(*T: Entry) -> tuple[Entry, ...]:
    r00, r01, r02, x, r10, r11, r12, y, r20, r21, r22, z, _, _, _, _ = T
    return (
        *(r00, r01, r02, y * r20 - z * r10, y * r21 - z * r11, y * r22 - z * r12),
        *(r10, r11, r12, z * r00 - x * r20, z * r01 - x * r21, z * r02 - x * r22),
        *(r20, r21, r22, x * r10 - y * r00, x * r11 - y * r01, x * r12 - y * r02),
        *(0.0, 0.0, 0.0, r00, r01, r02),
        *(0.0, 0.0, 0.0, r10, r11, r12),
        *(0.0, 0.0, 0.0, r20, r21, r22),
    )


def _left_jacobian(x: Entry, y: Entry, z: Entry, a: Entry, b: Entry, c: Entry) -> tuple[Entry, ...]:
    B, C, E, F = _branch(a * a + b * b + c * c, _series_bcef, _closed_bcef)
    return _dual(x, y, z, a, b, c, B, C, -E, -F)


def _left_jacobian_inverse(x: Entry, y: Entry, z: Entry, a: Entry, b: Entry, c: Entry) -> tuple[Entry, ...]:
    D, G = _branch(a * a + b * b + c * c, _series_dg, _closed_dg)
    return _dual(x, y, z, a, b, c, -0.5, D, 0.0, G)


def _dual(
    x: Entry, y: Entry, z: Entry, a: Entry, b: Entry, c: Entry, f: Entry, g: Entry, df: Entry, dg: Entry
) -> tuple[Entry, ...]:
    """Return [[M, N], [0, M]] with M = I + f W + g W^2, N its derivative along v; df, dg are 2 df/ds, 2 dg/ds."""
    fa, fb, fc = f * a, f * b, f * c
    gab, gac, gbc = g * a * b, g * a * c, g * b * c
    m00, m01, m02 = 1.0 - g * (b * b + c * c), gab - fc, gac + fb
    m10, m11, m12 = gab + fc, 1.0 - g * (a * a + c * c), gbc - fa
    m20, m21, m22 = gac - fb, gbc + fa, 1.0 - g * (a * a + b * b)
    # N = f V + g (W V + V W) + d (df W + dg W^2), d = w . v
    ax, by, cz = a * x, b * y, c * z
    d = ax + by + cz
    h, k = d * df, d * dg
    n0, n1, n2 = f * x + h * a, f * y + h * b, f * z + h * c
    o01 = g * (a * y + b * x) + k * a * b
    o02 = g * (a * z + c * x) + k * a * c
    o12 = g * (b * z + c * y) + k * b * c
    n00 = -2.0 * g * (by + cz) - k * (b * b + c * c)
    n11 = -2.0 * g * (ax + cz) - k * (a * a + c * c)
    n22 = -2.0 * g * (ax + by) - k * (a * a + b * b)
    return (
        *(m00, m01, m02, n00, o01 - n2, o02 + n1),
        *(m10, m11, m12, o01 + n2, n11, o12 - n0),
        *(m20, m21, m22, o02 - n1, o12 + n0, n22),
        *(0.0, 0.0, 0.0, m00, m01, m02),
        *(0.0, 0.0, 0.0, m10, m11, m12),
        *(0.0, 0.0, 0.0, m20, m21, m22),
    )


def _maths(entry: Entry) -> ModuleType:
    return math if isinstance(entry, float) else np


def _polynomial(coefficients: Sequence[float], s: Entry) -> Entry:
    total: Entry = coefficients[-1]
    for coefficient in coefficients[-2::-1]:
        total = total * s + coefficient
    return total


def _branch(s: Entry, series: Formula, closed: Formula, *more: Entry) -> tuple[Entry, ...]:
    """Evaluate ``series`` where s < 1 and ``closed`` elsewhere."""
    if isinstance(s, float):
        return series(s, *more) if s < 1.0 else closed(s, *more)
    small = s < 1.0
    if small.all():
        return series(s, *more)
    below = series(np.where(small, s, 0.0), *more)
    above = closed(np.where(small, 1.0, s), *more)
    return tuple(np.where(small, low, high) for low, high in zip(below, above, strict=True))


def _series_abc(s: Entry) -> tuple[Entry, ...]:
    return _polynomial(SERIES_A, s), _polynomial(SERIES_B, s), _polynomial(SERIES_C, s)


def _closed_abc(s: Entry) -> tuple[Entry, ...]:
    maths = _maths(s)
    theta = maths.sqrt(s)
    sine, cosine = maths.sin(0.5 * theta), maths.cos(0.5 * theta)
    A = 2.0 * sine * cosine / theta
    return A, 2.0 * sine * sine / s, (1.0 - A) / s


def _series_bcef(s: Entry) -> tuple[Entry, ...]:
    return tuple(_polynomial(series, s) for series in (SERIES_B, SERIES_C, SERIES_E, SERIES_F))


def _closed_bcef(s: Entry) -> tuple[Entry, ...]:
    A, B, C = _closed_abc(s)
    return B, C, (2.0 * B - A) / s, (3.0 * C - B) / s


def _series_d(s: Entry, cot: Entry) -> tuple[Entry, ...]:
    return (_polynomial(SERIES_D, s),)


def _closed_d(s: Entry, cot: Entry) -> tuple[Entry, ...]:
    return ((1.0 - 0.5 * _maths(s).sqrt(s) * cot) / s,)


def _series_dg(s: Entry) -> tuple[Entry, ...]:
    return _polynomial(SERIES_D, s), _polynomial(SERIES_G, s)


def _closed_dg(s: Entry) -> tuple[Entry, ...]:
    maths = _maths(s)
    half = 0.5 * maths.sqrt(s)
    sine = maths.sin(half)
    half_cot = half * maths.cos(half) / sine
    return (1.0 - half_cot) / s, (half * half / (sine * sine) + half_cot - 2.0) / (s * s)


def _angle_per_sine(qw: Entry, n2: Entry) -> tuple[Entry, Entry]:
    """Return rotation vector per vector part of an unnormalised quaternion with qw >= 0, and cot of the half angle."""
    # Below this the squares underflow; the angle is then 2 |q| / qw to the last bit, and the cotangent is not used.
    tiny = n2 < 1e-290
    if isinstance(n2, float):
        if tiny:
            return 2.0 / qw, 0.0
        n = math.sqrt(n2)
        return 2.0 * math.atan2(n, qw) / n, qw / n
    sine = np.sqrt(np.where(tiny, 1.0, n2))
    return np.where(tiny, 2.0 / np.where(tiny, qw, 1.0), 2.0 * np.arctan2(sine, qw) / sine), qw / sine


def _quaternion(
    r00: float, r01: float, r02: float, r10: float, r11: float, r12: float, r20: float, r21: float, r22: float
) -> tuple[float, ...]:
    """Return the unnormalised quaternion (w >= 0, x, y, z), from the row of 4 q q' with the largest diagonal."""
    trace = r00 + r11 + r22
    if trace > 0.0:
        w, x, y, z = 1.0 + trace, r21 - r12, r02 - r20, r10 - r01
    elif r00 >= r11 and r00 >= r22:
        w, x, y, z = r21 - r12, 1.0 + r00 - r11 - r22, r01 + r10, r02 + r20
    elif r11 >= r22:
        w, x, y, z = r02 - r20, r01 + r10, 1.0 + r11 - r22 - r00, r12 + r21
    else:
        w, x, y, z = r10 - r01, r02 + r20, r12 + r21, 1.0 + r22 - r00 - r11
    return (-w, -x, -y, -z) if w < 0.0 else (w, x, y, z)


def _quaternion_columns(
    r00: Array, r01: Array, r02: Array, r10: Array, r11: Array, r12: Array, r20: Array, r21: Array, r22: Array
) -> tuple[Array, ...]:
    """Compute ``_quaternion`` for columns."""
    trace = r00 + r11 + r22
    w, x, y, z = 1.0 + trace, r21 - r12, r02 - r20, r10 - r01
    turned = np.flatnonzero(trace <= 0.0)
    if turned.size:
        R = np.stack([entry[turned] for entry in (r00, r01, r02, r10, r11, r12, r20, r21, r22)]).reshape(3, 3, -1)
        i = np.argmax([R[0, 0], R[1, 1], R[2, 2]], axis=0)
        j, k, n = (i + 1) % 3, (i + 2) % 3, np.arange(i.size)
        vector = np.empty((3, i.size))
        vector[i, n] = 1.0 + R[i, i, n] - R[j, j, n] - R[k, k, n]
        vector[j, n] = R[i, j, n] + R[j, i, n]
        vector[k, n] = R[i, k, n] + R[k, i, n]
        sine = R[k, j, n] - R[j, k, n]
        sign = np.where(sine < 0.0, -1.0, 1.0)
        w[turned] = sign * sine
        x[turned], y[turned], z[turned] = sign * vector
    return w, x, y, z
