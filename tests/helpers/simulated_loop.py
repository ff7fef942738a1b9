"""Control loop around the simulated arm, on virtual time, with the true contact in place of perception."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from touchcell.drivers.core.clock import VirtualClock
from touchcell.drivers.core.scene import ContactState
from touchcell.geometry import se3
from touchcell.geometry.gaussian import PoseGaussian
from touchcell.geometry.types import Array
from touchcell.perception.runtime.estimate import ContactEstimate
from touchcell.simulation.devices.arm import SimArm, SimArmConfig
from touchcell.simulation.scene import Scene, SceneConfig
from touchcell.tasks.interface import Observation, Task, TaskContext

T_TCP_SENSOR = se3.from_euler_mm_deg(np.array([0.0, 0.0, 50.0, 0.0, 0.0, 0.0]))
COVARIANCE = np.diag([1e-8] * 3 + [1e-6] * 3)


@dataclass
class Log:
    """Record of each cycle while the task was in state ``run``."""

    t_s: list[float] = field(default_factory=list)
    truth: list[ContactState] = field(default_factory=list)

    def labels(self, after_s: float = 0.0) -> Array:
        """Return (n, 6) true contacts as x, y, z mm and alpha, beta, gamma degrees, from ``after_s`` into the run."""
        poses = [c.T_f_s for t, c in zip(self.t_s, self.truth, strict=True) if t >= self.t_s[0] + after_s]
        return se3.to_euler_mm_deg(np.array(poses))

    def depth_rms_mm(self, depth_mm: float, after_s: float = 0.0) -> float:
        """Return the root mean square of the depth error."""
        return float(np.sqrt(np.mean((self.labels(after_s)[:, 2] - depth_mm) ** 2)))

    def tilt_rms_deg(self, after_s: float = 0.0) -> float:
        """Return the root mean square of the angle between the sensor's axis and the surface normal."""
        labels = np.radians(self.labels(after_s))
        tilt = np.arccos(np.clip(np.cos(labels[:, 3]) * np.cos(labels[:, 4]), -1.0, 1.0))
        return float(np.degrees(np.sqrt(np.mean(tilt**2))))


class SimulatedLoop:
    """One simulated arm with a sensor 50 mm below its tool centre point, over one scene.

    Args:
        surface: settings of the one surface, as in the ``scene:`` section of a cell file.
        start_mm_deg: pose of the sensor at the start.
        frame_rate_hz: frame rate.
        latency_s: from a frame's capture until its estimate is available.
        noise: standard deviations (6,) of the estimate's [v, w] left perturbation, m and rad.
    """

    def __init__(
        self,
        surface: dict[str, Any],
        start_mm_deg: tuple[float, ...],
        *,
        rate_hz: float = 100.0,
        frame_rate_hz: float = 30.0,
        latency_s: float = 0.015,
        noise: Array | None = None,
        seed: int = 0,
    ) -> None:
        self.clock = VirtualClock()
        self.scene: Scene = SceneConfig.model_validate({"surfaces": {"it": surface}}).build(self.clock)
        T_world_tcp = se3.compose(se3.from_euler_mm_deg(np.array(start_mm_deg)), se3.inverse(T_TCP_SENSOR))
        config = SimArmConfig(start_pose_mm_deg=tuple(se3.to_euler_mm_deg(T_world_tcp)))
        self.arm = SimArm("arm", config, self.clock, self.scene.timeline)
        self.scene.mount("sensor", lambda: self.arm.T_world_tcp() @ T_TCP_SENSOR)
        self.context = TaskContext(rate_hz, {"sensor": T_TCP_SENSOR})
        self._frame_ns = round(1e9 / frame_rate_hz)
        self._latency_ns = round(latency_s * 1e9)
        self._noise = noise
        self._random = np.random.default_rng(seed)
        self._newest: ContactEstimate | None = None

    def run(self, task: Task, *, limit_s: float = 60.0, stop_when: Callable[[Observation], bool] | None = None) -> Log:
        """Run the task until it has finished; ``stop_when`` is the operator's stop request."""
        log, period_ns = Log(), round(1e9 / self.context.rate_hz)
        stopping = False
        with self.arm:
            self.arm.configure()
            self.arm.activate()
            lease = self.arm.acquire("test")
            while not task.finished and self.clock.now_ns() < limit_s * 1e9:
                self.clock.sleep_until_ns(self.clock.now_ns() + period_ns)
                observation = self.observe(stopping)
                action = task.tick(observation)
                if "arm" in action.twists:
                    self.arm.send_twist(action.twists["arm"], lease)
                else:
                    self.arm.stop()
                if task.state == "run":
                    log.t_s.append(self.clock.now_ns() * 1e-9)
                    log.truth.append(self.scene.contact("sensor").value)
                stopping = stopping or (stop_when is not None and stop_when(observation))
        return log

    def observe(self, operator_stop: bool) -> Observation:
        """Return the present observation of a cell."""
        now_ns = self.clock.now_ns()
        seq = (now_ns - self._latency_ns) // self._frame_ns
        if seq >= 0 and (self._newest is None or self._newest.seq != seq):
            state = self.scene.contact("sensor", seq * self._frame_ns).value
            T_s_f = state.T_s_f
            if self._noise is not None:
                T_s_f = se3.compose(se3.exp(self._noise * self._random.standard_normal(6)), T_s_f)
            belief = PoseGaussian(T_s_f, COVARIANCE) if state.in_contact else None
            t_ns = seq * self._frame_ns
            self._newest = ContactEstimate(state.in_contact, belief, t_ns, seq, t_ns)
        contacts = {} if self._newest is None else {"sensor": self._newest}
        return Observation(now_ns, {"arm": self.arm.tcp()}, contacts, operator_stop)
