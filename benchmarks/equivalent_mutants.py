"""Mutants that no test can notice, because what they change has no effect that anything outside can see.

Each is named by its module, the line of source that it changes and the change, with the reason. A line that is edited
loses its entries, so that a reason cannot outlive the code that it is about.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

SHORTCUT: Final = "a shortcut that gives what the rest would"
EXACT: Final = "differs only where a computed number equals its limit to the last bit"
MIDDLE: Final = "both are equal only in the middle of the box"
BEYOND: Final = "the rows or columns that it adds are not read, or do not exist"
SOMEWHERE: Final = "where an imagined pair stands decides nothing"

EQUIVALENT: Mapping[tuple[str, str, str], str] = {
    ("gate", "if linear <= max_linear and angular <= max_angular:", "if -> if False"): SHORTCUT,
    ("gate", "if linear <= max_linear and angular <= max_angular:", "LtE -> Lt"): SHORTCUT,
    ("gate", "_NEGLIGIBLE = 1e-12", "1e-12 -> 2e-12"): "a way of a picometre per second",
    ("gate", "if left > _NEGLIGIBLE:", "Gt -> GtE"): "a way of a picometre per second",
    ("gate", "if asked > jerk * _ROUNDING:", "Gt -> GtE"): EXACT,
    ("gate", "if size > limit * _ROUNDING:", "Gt -> GtE"): EXACT,
    (
        "gate",
        "asked = max(step, rate * left if smooth < rate else 0.0) / dt_s",
        "Lt -> LtE",
    ): "both are equal only where neither asks for more than the jerk",
    ("boundary", "return self.inward >= self.rest and self.inward >= _INWARD_SHARE * self.speed", "GtE -> Gt"): EXACT,
    ("boundary", "return self.measured_inward >= least", "GtE -> Gt"): EXACT,
    ("boundary", "above = p[axis] - high[axis] > low[axis] - p[axis]", "Gt -> GtE"): MIDDLE,
    ("boundary", "0.0 if excess <= 0.0 else excess if x - b > a - x else -excess", "Gt -> GtE"): MIDDLE,
    (
        "boundary",
        "0.0 if excess <= 0.0 else excess if x - b > a - x else -excess",
        "LtE -> Lt",
    ): "0 and -0 are both no way out",
    (
        "boundary",
        "return float(turning @ self.direction) / max(math.sin(tilt_rad), 1e-9), math.sqrt(float(turning @ turning))",
        "1e-09 -> 2e-09",
    ): "only keeps a division by zero away",
    ("pair", "T_world_sensor[:3, 3] = [0.1 * side, 0.0, 0.3]", "Mult -> Div"): "a side is 1 or -1",
    ("pair", "T_world_sensor[:3, 3] = [0.1 * side, 0.0, 0.3]", "0.3 -> 0.6"): SOMEWHERE,
    ("pair", "T_world_sensor[:3, 3] = [0.1 * side, 0.0, 0.3]", "0.1 -> 0.2"): SOMEWHERE,
    ("pair", "shear = -sensor.T_s_f[:3, :3].T @ sensor.T_s_f[:3, 3]", "-x -> +x"): "only its size counts",
    ("pair", "shear = -sensor.T_s_f[:3, :3].T @ sensor.T_s_f[:3, 3]", "3 -> 6"): BEYOND,
    ("pair", "R = carried.pose(view, sensor)[:3, :3] @ sensor.T_s_f[:3, :3]", "3 -> 6"): BEYOND,
    ("pair", "down = T_world_sensor[:3, :3].T @ np.array([0.0, 0.0, -1.0])", "3 -> 6"): BEYOND,
    ("pair", "down = T_world_sensor[:3, :3].T @ np.array([0.0, 0.0, -1.0])", "-x -> +x"): "it slides up",
    (
        "pair",
        "upright = np.array([0.0, 0.0, 0.0, 0.0, -0.5 * math.pi * side, 0.0])",
        "Mult -> Div",
    ): "a side is 1 or -1",
    ("pair", "leaning = np.array([0.0, 0.0, 0.0, 0.0, -lean_rad, 0.0])", "-x -> +x"): "it leans to the other side",
    ("collision", "_TINY = 1e-30", "1e-30 -> 2e-30"): "only keeps a division by zero away",
    ("collision", "if i.size:", "if -> if True"): SHORTCUT,
    ("collision", "if k.size:", "if -> if True"): SHORTCUT,
    (
        "collision",
        "s = np.where(slant > 1e-12 * uu * vv, uv * vw - vv * uw, 0.0) / np.maximum(slant, _TINY)",
        "Gt -> GtE",
    ): (EXACT),
    (
        "collision",
        "s = np.where(slant > 1e-12 * uu * vv, uv * vw - vv * uw, 0.0) / np.maximum(slant, _TINY)",
        "1e-12 -> 2e-12",
    ): "of lines that are parallel to a millionth all points are equally near to a micrometre",
    ("collision", "at = np.zeros((len(p), 8))", "8 -> 16"): "what it adds is the start of the segment once more",
    ("clearance", "if not np.min(apart, initial=np.inf) < self.slow_m:", "if -> if False"): SHORTCUT,
    ("clearance", "if not np.min(apart, initial=np.inf) < self.slow_m:", "Lt -> LtE"): SHORTCUT,
    (
        "clearance",
        "change = self.clearances.distances(self._frames(view, _AHEAD_S)) - apart if commanded "
        "else np.zeros_like(apart)",
        "x if c else y -> c = True",
    ): "without a command nothing moves ahead",
    ("clearance", "wrong = (apart < self.slow_m) & (change < -_NEGLIGIBLE_M)", "Lt -> LtE"): EXACT,
    (
        "clearance",
        "parting = (change >= REST_M_S * _AHEAD_S) & (measured > -2.0 * REST_M_S * _AHEAD_S)",
        "GtE -> Gt",
    ): EXACT,
    (
        "clearance",
        "parting = (change >= REST_M_S * _AHEAD_S) & (measured > -2.0 * REST_M_S * _AHEAD_S)",
        "Gt -> GtE",
    ): EXACT,
    ("clearance", "if (too_near := apart < self.limit_m).any():", "Lt -> LtE"): EXACT,
    ("clearance", "too_near = apart_m < self.limit_m", "Lt -> LtE"): EXACT,
    ("clearance", "if widest_m <= slow_m and least_m > widest_m:", "LtE -> Lt"): EXACT,
    ("clearance", "if widest_m <= slow_m and least_m > widest_m:", "Gt -> GtE"): EXACT,
    ("clearance", "if distance < limit_m:", "Lt -> LtE"): EXACT,
    ("clearance", "if widest_m > slow_m and len(near) == len(bodies):", "Gt -> GtE"): EXACT,
    ("clearance", "if widest_m > slow_m and len(near) == len(bodies):", "if -> if False"): SHORTCUT,
    ("clearance", "if number % 2 or np.linalg.norm(placed[:3, 3]) > reach_m:", "Gt -> GtE"): EXACT,
    ("depth_disagrees", "if slid_m > self.slide_m:", "Gt -> GtE"): EXACT,
    (
        "depth_disagrees",
        "if mark is not None:",
        "if -> if True",
    ): "None is as no mark",
    ("motion", "command = TwistCommand(twist, TwistFrame.BASE, view.now_ns, 0.03)", "0.03 -> 0.06"): (
        "nothing reads the time-to-live of a fault's command"
    ),
    ("motion", "position = arm.state.value.T_base_tcp[:3, 3]", "3 -> 6"): BEYOND,
    ("always_on", "if not view.sensors.keys() <= past.keys():", "if -> if True"): SHORTCUT,
    ("always_on", "if not view.sensors.keys() <= past.keys():", "LtE -> Lt"): SHORTCUT,
    (
        "always_on",
        "if self.arms <= view.arms.keys() and self.sensors <= view.sensors.keys():",
        "if -> if False",
    ): SHORTCUT,
    ("always_on", "if self.arms <= view.arms.keys() and self.sensors <= view.sensors.keys():", "LtE -> Lt"): SHORTCUT,
    ("always_on", "return replace(view, now_ns=view.now_ns + round(1e9 * SILENCE_S))", "Mult -> Div"): "it is 1 s",
    ("supervisor", "if not names and not self._limiting:", "if -> if False"): SHORTCUT,
    (
        "supervisor",
        "self._levelled = rule if isinstance(rule, Levelled) else None",
        "x if c else y -> c = True",
    ): "a rule without levels raises when it is asked for them, which is suppressed",
    ("supervisor", "if self._levelled is not None:", "if -> if True"): "None raises, which is suppressed",
    ("supervisor", "if total_ns or name in names:", "if -> if True"): "an entry that counts nothing is as none",
    ("collision", "safe = np.where(np.abs(d) > _TINY, d, 1.0)", "Gt -> GtE"): EXACT,
    ("collision", "rising = np.where(slope[:, -1] < 0.0, 7, rising)", "Lt -> LtE"): EXACT,
    (
        "collision",
        "share = np.where(change > 0.0, np.clip(-low / np.where(change > 0.0, change, 1.0), 0.0, 1.0), 0.0)",
        "Gt -> GtE",
    ): EXACT,
    ("collision", "best = np.where(slope[:, -1] < 0.0, 1.0, best)", "Lt -> LtE"): EXACT,
    ("rest", "_MOST_SEEN: Final = 1000", "1000 -> 2000"): "only bounds the memory",
    (
        "rest",
        "moved = np.array([np.linalg.norm(extent[:3, 3]), np.linalg.norm(extent[:3, :3]) / np.sqrt(2.0)])",
        "3 -> 6",
    ): "the last row of a pose never changes, so that it adds nothing to an extent",
    (
        "rest",
        "return bool((moved <= self._rest * 1e-9 * lasted_ns).all() and (speeds[-1] <= 2.0 * usual).all())",
        "LtE -> Lt",
    ): EXACT,
    (
        "command_checks",
        "if twist is command.twist and t_ns is command.t_ns and ttl_s is command.ttl_s "
        "and type(command) is TwistCommand:",
        "if -> if False",
    ): SHORTCUT,
}
"""Reason by module, line of source without its indentation, and change."""


def equivalent(module: str, source: str, line: int, what: str) -> str:
    """Return the reason why a mutant of ``source`` at ``line`` is equivalent; "" if it is not known to be."""
    return EQUIVALENT.get((module, source.splitlines()[line - 1].strip(), what), "")
