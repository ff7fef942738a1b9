"""``python -m benchmarks tip-fem``: the simulated tip's deformation against finite elements, on a few shapes.

The reference is a homogeneous elastic ball of 20 mm whose upper half is held, pressed by a rigid part, at rest:
MuJoCo's flex (tetrahedra, Saint Venant-Kirchhoff). It is no TacTip, whose skin is stiffer than its gel: on a plane the
simulated tip is fitted to real images and differs. What is compared is what a shape changes against a plane of the same
depth.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from touchcell.cell.bench.provenance import provenance
from touchcell.geometry.types import Array
from touchcell.simulation.closed_forms import Box
from touchcell.simulation.contact import ContactLaw
from touchcell.simulation.motions import Still
from touchcell.simulation.pressed import pressed
from touchcell.simulation.relief import felt_relief
from touchcell.simulation.surfaces import Plane, Sphere, Surface
from touchcell.simulation.tip import Tip

_RADIUS_M: Final = 0.020
_STEP_S: Final = 0.0005
_PRESS_S: Final = 0.3
_REST_S: Final = 0.3
_YOUNG_PA: Final = 1e3
_POISSON: Final = 0.45
_FRAMES: Final = 200
_BLOCK: Final = (0.1, 0.1, 0.04)


@dataclass(frozen=True)
class _Case:
    """A part whose highest face is z = 0.

    Attributes:
        surface: as the simulated tip feels it.
        geom: the same in MuJoCo's XML.
    """

    surface: Surface
    geom: str


def _block(x: float, y: float) -> _Case:
    T = np.eye(4)
    T[:3, 3] = x, y, -_BLOCK[2]
    half = [0.5 * size for size in _BLOCK]
    geom = f'type="box" size="{half[0]} {half[1]} {half[2]}" pos="{x} {y} {-half[2]}"'
    return _Case(Surface(Box(_BLOCK), Still(T)), geom)


def _cases() -> dict[str, _Case]:
    inside = -0.5 * _BLOCK[0]
    T_ball = np.eye(4)
    T_ball[2, 3] = -_RADIUS_M
    ball = Surface(Sphere(_RADIUS_M), Still(T_ball))
    return {
        "plane": _Case(Surface(Plane()), _block(0.0, 0.0).geom),
        "ball of 20 mm": _Case(ball, f'type="sphere" size="{_RADIUS_M}" pos="0 0 {-_RADIUS_M}"'),
        "edge": _block(inside, 0.0),
        "edge, 2 mm inside": _block(inside + 0.002, 0.0),
        "corner": _block(inside, inside),
    }


def run(arguments: Sequence[str] = (), out: Path = Path("bench")) -> None:
    """Press on each shape with both, print how the markers move, and how long it takes."""
    parser = argparse.ArgumentParser("python -m benchmarks tip-fem", description=__doc__.partition("\n")[0])
    parser.add_argument("--count", type=int, default=17, help="nodes along each side of the grid (17)")
    parser.add_argument("--depth-mm", type=float, default=3.0, help="indentation (3)")
    options = parser.parse_args(arguments)
    depth_m = 1e-3 * options.depth_mm
    tip = Tip()
    T_world_s = np.diag([1.0, -1.0, -1.0, 1.0])
    T_world_s[2, 3] = _RADIUS_M - depth_m
    lines = [
        "; ".join(f"{key} {value}" for key, value in provenance().items()),
        f"{options.depth_mm:g} mm deep; 331 markers, mm in the sensor's frame;"
        f" finite elements of {options.count} nodes a side, Poisson's ratio {_POISSON:g}",
        f"{'':20s}{'moved, RMS':>20s}{'by the shape, of the plane':>30s}{'alike':>8s}{'time':>22s}",
        f"{'':20s}{'elements':>10s}{'tip':>10s}{'elements':>15s}{'tip':>15s}{'':8s}{'elements':>12s}{'tip':>10s}",
    ]
    of_plane: tuple[Array, Array] | None = None
    for name, case in _cases().items():
        reference, cpu_s = _elements(case.geom, tip, depth_m, options.count)
        moved, frame_s = _simulated(case.surface, tip, T_world_s)
        of_plane = of_plane or (reference, moved)
        row = f"{name:20s}{_rms(reference):10.2f}{_rms(moved):10.2f}"
        one, other = ((here - flat) / _rms(flat) for here, flat in zip((reference, moved), of_plane, strict=True))
        if name == "plane":
            row += " " * 38
        else:
            alike = float((one * other).sum() / np.sqrt((one**2).sum() * (other**2).sum()))
            row += f"{_rms(one):15.2f}{_rms(other):15.2f}{alike:8.2f}"
        lines.append(f"{row}{cpu_s:10.0f} s{1e3 * frame_s:7.2f} ms")
    lines.append(
        "by the shape: RMS of what differs from the plane's displacements, as a share of these; alike: cosine between"
        " both; time: CPU time of the simulation, and the least of a frame's markers"
    )
    text = "\n".join(lines)
    print(text)
    (out / "tip_fem.txt").write_text(text + "\n", encoding="utf-8")


def _rms(moved: Array) -> float:
    return 1e3 * float(np.sqrt((moved**2).sum(axis=1).mean()))


def _simulated(surface: Surface, tip: Tip, T_world_s: Array) -> tuple[Array, float]:
    """Return how the markers move (markers, 3) m, and the least CPU time of a frame."""
    law = ContactLaw()
    state, _ = pressed(surface, tip, law, T_world_s, T_world_s)
    fastest_s = math.inf
    for _ in range(_FRAMES):
        started = time.process_time()
        relief = felt_relief(surface, T_world_s, 0.0, tip.relief.directions, law.tip_radius_m)
        positions = tip.marker_positions(state.T_f_s, relief)
        tip.project(positions)
        fastest_s = min(fastest_s, time.process_time() - started)
    return positions - tip.rest_positions, fastest_s


def _elements(geom: str, tip: Tip, depth_m: float, count: int) -> tuple[Array, float]:
    """Return how the markers move (markers, 3) m in the sensor's frame, and the CPU time."""
    import mujoco
    from scipy.interpolate import LinearNDInterpolator

    started = time.process_time()
    free = mujoco.MjModel.from_xml_string(_xml(geom, count, ""))
    data = mujoco.MjData(free)
    mujoco.mj_forward(free, data)
    rest = data.flexvert_xpos.copy()
    held = np.flatnonzero(rest[:, 2] >= _RADIUS_M - 1e-5)
    model = mujoco.MjModel.from_xml_string(_xml(geom, count, f'<pin id="{" ".join(map(str, held))}"/>'))
    data = mujoco.MjData(model)
    for i in range(round((_PRESS_S + _REST_S) / _STEP_S)):
        data.mocap_pos[0, 2] = depth_m * min(i * _STEP_S / _PRESS_S, 1.0)
        mujoco.mj_step(model, data)
    moved: Any = LinearNDInterpolator(rest, data.flexvert_xpos - rest)
    flip = np.array([1.0, -1.0, -1.0])
    at_markers: Array = moved(tip.rest_positions * flip + [0.0, 0.0, _RADIUS_M]) * flip
    return at_markers, time.process_time() - started


def _xml(geom: str, count: int, pins: str) -> str:
    spacing = 2.0 * _RADIUS_M / (count - 1)
    return f"""<mujoco>
      <option timestep="{_STEP_S}" gravity="0 0 0" solver="CG" iterations="300" tolerance="1e-8" integrator="discrete"/>
      <worldbody>
        <body name="part" mocap="true"><geom {geom} solref="0.002 1"/></body>
        <body name="tip" pos="0 0 {_RADIUS_M}">
          <flexcomp name="skin" type="ellipsoid" count="{count} {count} {count}" spacing="{spacing} {spacing} {spacing}"
                    dim="3" radius="0.0001" mass="0.03">
            <elasticity young="{_YOUNG_PA}" poisson="{_POISSON}" damping="0.01"/>
            <contact selfcollide="none" solref="0.002 1" solimp="0.99 0.999 0.0001" friction="1 0 0"/>
            {pins}
          </flexcomp>
        </body>
      </worldbody>
    </mujoco>"""
