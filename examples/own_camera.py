"""A driver of one's own, as short as it can be: a camera of noise. ``touchcell new camera`` makes a package of it."""

import numpy as np

import touchcell as tc
from touchcell.drivers.core.clock import MonotonicClock
from touchcell.drivers.core.device import Device
from touchcell.drivers.core.errors import StaleData
from touchcell.drivers.core.samples import Frame, Stamped


class NoiseCamera(Device):
    """Delivers a new random image every 50 ms."""

    def latest(self, max_age_s: float | None = None) -> Stamped[Frame]:
        now_ns = self._clock.now_ns()
        seq = now_ns // 50_000_000
        t_ns = seq * 50_000_000  # when it was exposed, not when it is read
        if max_age_s is not None and (now_ns - t_ns) * 1e-9 > max_age_s:
            raise StaleData(self.name, (now_ns - t_ns) * 1e-9, max_age_s, seq)
        return Stamped(Frame(np.random.default_rng(seq).integers(0, 256, (480, 640), np.uint8)), t_ns, seq)

    def next(self, after_seq: int, timeout_s: float) -> Stamped[Frame]:
        self._clock.sleep_until_ns((after_seq + 1) * 50_000_000)
        return self.latest()

    def _open(self) -> None: ...

    def _close(self) -> None: ...


clock = MonotonicClock()
with tc.ConnectedCamera(NoiseCamera("camera", clock), "noise", clock) as camera:
    print(camera, [camera.read().shape for _ in range(3)])
