"""``touchcell bench se3``: error and run time of our SE(3) compared with installed public libraries.

Errors are relative to mpmath, per block, the worst of the 1035 points of ``benchmarks.se3_reference``. Times are CPU
times, the best of several runs. Ours and pytransform3d take and return numpy arrays; pinocchio and scipy are timed on
their own objects, as their users call them. Ours are timed with argument checks, pytransform3d without.
"""

from __future__ import annotations

import argparse
import json
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from types import ModuleType
from typing import Any, TypeAlias

import numpy as np

from benchmarks.se3_reference import Library, errors, points, reference
from touchcell.cell.bench.provenance import provenance
from touchcell.geometry import _plain, se3
from touchcell.geometry.gaussian import PoseGaussian, compound, fuse
from touchcell.geometry.types import Array

BATCH = 100_000
OPERATIONS = ("exp", "log", "compose", "inverse", "adjoint", "left_jacobian", "left_jacobian_inverse")
BLOCKS = ("exp R", "exp t", "exp small", "log w", "log v", "round w", "round v", "J", "J^-1", "Ad")
BLOCKS_OF = {
    "exp": ("exp R", "exp t"),
    "log": ("log w", "log v"),
    "adjoint": ("Ad",),
    "left_jacobian": ("J",),
    "left_jacobian_inverse": ("J^-1",),
}

Call: TypeAlias = Callable[[], object]


@dataclass(frozen=True)
class Contender:
    """A library, and one call of each operation on prepared arguments: one element, and ``BATCH`` of them."""

    library: Library
    scalar: Mapping[str, Call]
    batch: Mapping[str, Call] = field(default_factory=dict)


def run(arguments: Sequence[str], out: Path) -> None:
    """Print the table; write ``se3.json`` and ``se3.png`` into ``out``."""
    argparse.ArgumentParser(prog="touchcell bench se3", description=__doc__.partition("\n")[0]).parse_args(arguments)
    xi = points()
    exact = reference(xi)
    result: dict[str, Any] = {"provenance": provenance(), "points": len(xi), "batch": BATCH, "libraries": {}}
    for contender in _contenders():
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = errors(contender.library, exact)
            result["libraries"][contender.library.name] = {
                "error": {name: float(np.max(error)) for name, error in found.items()},
                "scalar_us": {name: 1e6 * _seconds(call, 2000) for name, call in contender.scalar.items()},
                "batch_ns": {name: 1e9 / BATCH * _seconds(call, 1) for name, call in contender.batch.items()},
            }
    result["filter_us"] = {"backend": se3.BACKEND, **_filter_us()}
    _print(result)
    out.mkdir(parents=True, exist_ok=True)
    (out / "se3.json").write_text(json.dumps(result, indent=1) + "\n")
    _plot(result, out / "se3.png")
    print(f"\nwritten: {out / 'se3.json'}, {out / 'se3.png'}")


def _seconds(call: Call, count: int) -> float:
    """Return the CPU time of one call, the best of five rounds."""
    call()
    best = float("inf")
    for _ in range(5):
        start = time.process_time()
        for _ in range(count):
            call()
        best = min(best, (time.process_time() - start) / count)
    return best


def _filter_us() -> dict[str, float]:
    """Return the time of one prediction with noise and one correction, as a filter makes per image."""
    rng = np.random.default_rng(0)
    A, B, Q = (1e-4 * (factor @ factor.T + np.eye(6)) for factor in rng.normal(size=(3, 6, 6)))
    motion, offset = se3.exp(0.1 * rng.normal(size=(2, 6)))
    prior = PoseGaussian(se3.exp(rng.normal(size=6)), A)
    observation = PoseGaussian(se3.compose(offset, prior.mean), B)
    return {
        "compound": 1e6 * _seconds(lambda: compound(motion, prior, Q), 2000),
        "fuse": 1e6 * _seconds(lambda: fuse(prior, observation), 2000),
    }


def _contenders() -> list[Contender]:
    rng = np.random.default_rng(0)
    xi = rng.normal(size=(BATCH, 6))
    T = _plain.exp(xi)
    other = T[::-1].copy()
    found = []
    for make in (_compiled, _ours_plain, _pinocchio, _scipy, _pytransform3d):
        try:
            found.append(make(xi, T, other))
        except ImportError as error:
            print(f"skipped: {error}")
    return found


def _compiled(xi: Array, T: Array, other: Array) -> Contender:
    if se3.BACKEND != "compiled":
        raise ImportError("touchcell's C extension is not built, or TOUCHCELL_PURE_PYTHON is set")
    return _ours("touchcell, compiled", se3, xi, T, other)


def _ours_plain(xi: Array, T: Array, other: Array) -> Contender:
    return _ours("touchcell, plain", _plain, xi, T, other)


def _ours(name: str, kernels: ModuleType, xi: Array, T: Array, other: Array) -> Contender:
    arguments = {
        "exp": (xi,),
        "log": (T,),
        "compose": (T, other),
        "inverse": (T,),
        "adjoint": (T,),
        "left_jacobian": (xi,),
        "left_jacobian_inverse": (xi,),
    }
    return Contender(
        Library(name, **{operation: getattr(kernels, operation) for operation in BLOCKS_OF}),
        scalar={
            operation: _call(getattr(kernels, operation), *(batch[0] for batch in batches))
            for operation, batches in arguments.items()
        },
        batch={operation: _call(getattr(kernels, operation), *batches) for operation, batches in arguments.items()},
    )


def _call(function: Callable[..., Any], *arguments: Any) -> Call:
    return lambda: function(*arguments)


def _pinocchio(xi: Array, T: Array, other: Array) -> Contender:
    import pinocchio as pin

    # Its Jacobians are right ones: J_l(xi) = J_r(-xi), and Jlog6 is the inverse of J_r at the logarithm of a pose.
    library = Library(
        f"pinocchio {version('pin')}",
        exp=lambda xi: pin.exp6(xi).homogeneous,
        log=lambda T: pin.log6(T).vector,
        adjoint=lambda T: pin.SE3(T).action,
        left_jacobian=lambda xi: pin.Jexp6(-xi),
        left_jacobian_inverse=lambda xi: pin.Jlog6(pin.exp6(-xi)),
        batched=False,
    )
    motion, one, two, back = xi[0], pin.SE3(T[0]), pin.SE3(other[0]), pin.exp6(-xi[0])
    return Contender(
        library,
        scalar={
            "exp": lambda: pin.exp6(motion),
            "log": lambda: pin.log6(one),
            "compose": lambda: one * two,
            "inverse": one.inverse,
            "adjoint": lambda: one.action,
            "left_jacobian": lambda: pin.Jexp6(motion),
            "left_jacobian_inverse": lambda: pin.Jlog6(back),
        },
    )


def _scipy(xi: Array, T: Array, other: Array) -> Contender:
    from scipy.spatial.transform import RigidTransform

    library = Library(
        f"scipy {version('scipy')}",
        exp=lambda xi: RigidTransform.from_exp_coords(_swap(xi)).as_matrix(),
        log=lambda T: _swap(RigidTransform.from_matrix(T).as_exp_coords()),
    )

    def calls(w_first: Array, left: RigidTransform, right: RigidTransform) -> dict[str, Call]:
        return {
            "exp": lambda: RigidTransform.from_exp_coords(w_first),
            "log": left.as_exp_coords,
            "compose": lambda: left * right,
            "inverse": left.inv,
        }

    left, right = RigidTransform.from_matrix(T), RigidTransform.from_matrix(other)
    return Contender(library, calls(_swap(xi[0]), left[0], right[0]), calls(_swap(xi), left, right))


def _pytransform3d(xi: Array, T: Array, other: Array) -> Contender:
    import pytransform3d.trajectories as many
    import pytransform3d.transformations as single

    library = Library(
        f"pytransform3d {version('pytransform3d')}",
        exp=lambda xi: single.transform_from_exponential_coordinates(_swap(xi)),
        log=lambda T: _swap(single.exponential_coordinates_from_transform(T)),
        adjoint=lambda T: _swap_square(single.adjoint_from_transform(T)),
        left_jacobian=lambda xi: _swap_square(single.left_jacobian_SE3(_swap(xi))),
        left_jacobian_inverse=lambda xi: _swap_square(single.left_jacobian_SE3_inv(_swap(xi))),
        batched=False,
    )
    w_first, one, two, all_w_first = _swap(xi[0]), T[0], other[0], _swap(xi)
    return Contender(
        library,
        scalar={
            "exp": lambda: single.transform_from_exponential_coordinates(w_first, check=False),
            "log": lambda: single.exponential_coordinates_from_transform(one, check=False),
            "compose": lambda: single.concat(two, one, check=False),
            "inverse": lambda: single.invert_transform(one, check=False),
            "adjoint": lambda: single.adjoint_from_transform(one, check=False),
            "left_jacobian": lambda: single.left_jacobian_SE3(w_first),
            "left_jacobian_inverse": lambda: single.left_jacobian_SE3_inv(w_first),
        },
        batch={
            "exp": lambda: many.transforms_from_exponential_coordinates(all_w_first),
            "log": lambda: many.exponential_coordinates_from_transforms(T),
            "compose": lambda: many.concat_many_to_many(other, T),
            "inverse": lambda: many.invert_transforms(T),
        },
    )


def _swap(xi: Array) -> Array:
    """Return [v, w] from [w, v], or vice versa."""
    return np.concatenate([xi[..., 3:], xi[..., :3]], axis=-1)


def _swap_square(matrix: Array) -> Array:
    order = [3, 4, 5, 0, 1, 2]
    return matrix[np.ix_(order, order)]


def _print(result: Mapping[str, Any]) -> None:
    libraries = result["libraries"]
    print(", ".join(f"{key} {value}" for key, value in result["provenance"].items()))
    for title, part, columns, form in (
        (f"worst relative error at {result['points']} points", "error", BLOCKS, "{:.0e}"),
        ("one element, us per call", "scalar_us", OPERATIONS, "{:.2f}"),
        (f"batch of {result['batch']}, ns per element", "batch_ns", OPERATIONS, "{:.0f}"),
    ):
        short = [column.replace("left_jacobian", "J").replace("_inverse", "^-1") for column in columns]
        print(f"\n{title:42s}" + "".join(f"{column:>11s}" for column in short))
        for name, figures in libraries.items():
            cells = [form.format(figures[part][column]) if column in figures[part] else "-" for column in columns]
            print(f"{name:42s}" + "".join(f"{cell:>11s}" for cell in cells))
    filtering = result["filter_us"]
    steps = f"compound with noise {filtering['compound']:.1f}, fuse {filtering['fuse']:.1f}"
    print(f"\nfilter steps ({filtering['backend']}), us: {steps}")


def _plot(result: Mapping[str, Any], path: Path) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    figure = Figure(figsize=(9.0, 5.6), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    markers = dict(zip(BLOCKS_OF, "os^Dv", strict=True))
    colours = dict(zip(result["libraries"], ("C3", "C1", "C0", "C2", "C4"), strict=False))
    for name, figures in result["libraries"].items():
        for operation, blocks in BLOCKS_OF.items():
            if not all(block in figures["error"] for block in blocks):
                continue
            error = max(figures["error"][block] for block in blocks)
            axes.plot(
                figures["scalar_us"][operation],
                error,
                markers[operation],
                color=colours[name],
                markersize=9,
                alpha=0.85,
            )
    axes.axhline(np.finfo(float).eps, color="0.5", linewidth=1.0, linestyle=":")
    axes.text(0.995, np.finfo(float).eps, "eps", transform=axes.get_yaxis_transform(), ha="right", va="bottom")
    axes.set(xscale="log", yscale="log", xlabel="time of one call from Python, µs", ylabel="worst relative error")
    axes.set_title(
        f"SE(3) against mpmath, {result['points']} points from 0 to π\n{result['provenance']['cpu']}", fontsize=11
    )
    axes.grid(alpha=0.3)
    handles = [Line2D([], [], color=colour, marker="s", linestyle="", label=name) for name, colour in colours.items()]
    handles += [
        Line2D([], [], color="0.3", marker=marker, linestyle="", label=operation.replace("_", " "))
        for operation, marker in markers.items()
    ]
    figure.legend(handles=handles, loc="outside right upper", frameon=False)
    figure.savefig(path, dpi=150)
