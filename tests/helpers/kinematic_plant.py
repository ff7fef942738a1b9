"""Minimal plant that closes the loop: a tool that moves exactly as commanded, exact estimates of a flat surface."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from touchcell.drivers.core.samples import Stamped, TcpState
from touchcell.geometry import se3
from touchcell.geometry.gaussian import PoseGaussian
from touchcell.perception.runtime.estimate import ContactEstimate
from touchcell.tasks.interface import Action, Observation, Task, TaskContext

RATE_HZ = 100.0
DT = 1.0 / RATE_HZ
T_TCP_SENSOR = se3.from_euler_mm_deg(np.array([10.0, -5.0, 60.0, 20.0, -10.0, 30.0]))
CONTEXT = TaskContext(RATE_HZ, {"sensor": T_TCP_SENSOR})
COVARIANCE = np.diag([1e-8] * 3 + [1e-6] * 3)
UPSIDE_DOWN = se3.from_euler_mm_deg(np.array([0, 0, 0, 180.0, 0, 0]))


class KinematicPlant:
    """A sensor above a plane. The skin sticks where it first touches and never slips.

    Args:
        gap_mm: distance from the tip to the surface at the start.
        tilt_deg: (alpha, beta) of the sensor at the start.

    Attributes:
        velocity: (6,) twist of the surface, along its own axes.
        frozen: the arm ignores commands.
        frames, states: whether new ones arrive; old ones stay.
        touching: False hides the contact, True leaves it to geometry.
        in_range: the ``in_range`` flag of estimates.
        broken: the arm reports an invalid pose.
        seen: ``T_f_s`` (4, 4) of the latest cycle.
        operator_stop: whether the operator requests the end.
        force_n: the arm's measurement of the force on its tip for an indentation in mm; None measures none.
        image: difference of the image in free air from the gate's first reference; None for a plant without images.
            A depth of 1 mm changes it by 0.1.
        knocked: further difference, as of a camera that has been moved.
        gives_way_mm: depth from which the surface moves on with the sensor.
        zeros: how often a zero frame was taken.
    """

    def __init__(self, gap_mm: float = 5.0, tilt_deg: tuple[float, float] = (4.0, -3.0)) -> None:
        self.T_w_f = UPSIDE_DOWN
        T_f_s = se3.from_euler_mm_deg(np.array([0, 0, -gap_mm, *tilt_deg, 0]))
        self.T_w_s = se3.compose(self.T_w_f, T_f_s)
        self.now_ns = 0
        self.velocity = np.zeros(6)
        self.frozen = False
        self.frames = True
        self.states = True
        self.touching = True
        self.in_range = True
        self.broken = False
        self.operator_stop = False
        self.force_n: Callable[[float], float] | None = None
        self.image: float | None = None
        self.knocked = 0.0
        self.gives_way_mm = np.inf
        self.zeros = 0
        self._zero = 0.0
        self.twist = np.zeros(6)
        self.seen = T_f_s
        self._anchored = False
        self._seq = 0
        self._contact: ContactEstimate | None = None
        self._state: Stamped[TcpState] | None = None

    def sensor_in_surface(self) -> np.ndarray:
        """Return the true ``T_f_s`` (4, 4)."""
        return se3.compose(se3.inverse(self.T_w_f), self.T_w_s)

    def cycle(self, task: Task) -> Action:
        """Run one control cycle: observe, call the task, move."""
        self.now_ns += round(DT * 1e9)
        self.seen = self.sensor_in_surface()
        action = task.tick(self._observe())
        if action.zero and self.image is not None:
            self._zero = self._raw_image()
            self.zeros += 1
        command = action.twists.get("arm")
        self.twist = np.zeros(6) if command is None or self.frozen else command.twist
        T_w_tcp = se3.compose(self.T_w_s, se3.inverse(T_TCP_SENSOR))
        self.T_w_s = se3.compose(se3.compose(T_w_tcp, se3.exp(self.twist * DT)), T_TCP_SENSOR)
        self.T_w_f = se3.compose(self.T_w_f, se3.exp(self.velocity * DT))
        beyond_m = float(self.sensor_in_surface()[2, 3]) - 1e-3 * self.gives_way_mm
        if beyond_m > 0.0:
            self.T_w_f = se3.compose(self.T_w_f, se3.exp([0.0, 0.0, beyond_m, 0.0, 0.0, 0.0]))
        return action

    def run(self, task: Task, until: str | None = None, limit_s: float = 60.0) -> list[Action]:
        """Run cycles until the task is in state ``until``, or has finished."""
        actions: list[Action] = []
        for _ in range(round(limit_s * RATE_HZ)):
            if task.finished or task.state == until:
                return actions
            actions.append(self.cycle(task))
        raise AssertionError(f"still in {task.state} after {limit_s} s")

    def _observe(self) -> Observation:
        if self.states or self._state is None:
            T = se3.compose(self.T_w_s, se3.inverse(T_TCP_SENSOR))
            self._state = Stamped(TcpState(2.0 * T if self.broken else T, self.twist), self.now_ns, self._seq)
        if self.frames:
            self._seq += 1
            self._contact = self._estimate()
        contacts = {} if self._contact is None else {"sensor": self._contact}
        wrenches = {}
        if self.force_n is not None:
            force_n = self.force_n(max(1e3 * float(self.seen[2, 3]), 0.0))
            wrenches["arm"] = Stamped(np.array([0.0, 0.0, force_n, 0.0, 0.0, 0.0]), self.now_ns, self._seq)
        return Observation(self.now_ns, {"arm": self._state}, contacts, self.operator_stop, wrenches=wrenches)

    def _raw_image(self) -> float:
        assert self.image is not None
        return self.image + self.knocked + 100.0 * max(float(self.seen[2, 3]), 0.0)

    def _estimate(self) -> ContactEstimate:
        nothing = ContactEstimate(False, None, self.now_ns, self._seq, self.now_ns)
        if self.image is not None:
            change = abs(self._raw_image() - self._zero)
            if change > 0.04:
                belief = PoseGaussian(se3.inverse(self.sensor_in_surface()), COVARIANCE)
                return replace(nothing, in_contact=True, belief=belief, change=change)
            return replace(nothing, change=change)
        if not self.touching or self.seen[2, 3] <= 0.0:
            self._anchored = False
            return nothing
        if not self._anchored:
            # First touch: the surface frame moves to where there is no shear.
            labels = se3.to_euler_mm_deg(self.seen)
            shear = np.array([labels[0], labels[1], 0.0, 0.0, 0.0, labels[5]])
            self.T_w_f = se3.compose(self.T_w_f, se3.from_euler_mm_deg(shear))
            self._anchored = True
        belief = PoseGaussian(se3.inverse(self.sensor_in_surface()), COVARIANCE)
        return replace(nothing, in_contact=True, belief=belief, in_range=self.in_range, measured=belief)
