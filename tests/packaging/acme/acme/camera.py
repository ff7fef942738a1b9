"""A camera: an even grey picture, and a place in the simulated scene for its sensor."""

import numpy as np

from touchcell.drivers.core.device import Device
from touchcell.drivers.core.errors import StaleData
from touchcell.drivers.core.protocols import FrameSource, HealthSource
from touchcell.drivers.core.samples import Frame, Stamped
from touchcell.drivers.core.spec import Capabilities, DriverConfig, DriverContext, DriverSpec
from touchcell.simulation.devices.arm import SimArm
from touchcell.simulation.scene import Scene


class AcmeCameraConfig(DriverConfig):
    """Keys of a sensor with this driver."""

    mounted_on: str
    rate_hz: float = 30.0
    grey: int = 128


class AcmeCamera(Device):
    """Frames exist at whole multiples of the period, whether they are read or not."""

    def __init__(self, name: str, config: AcmeCameraConfig, context: DriverContext) -> None:
        super().__init__(name, context.clock)
        self._period_ns = round(1e9 / config.rate_hz)
        self._scene, self._arm = context.scene, context.devices[config.mounted_on]
        self._image = np.full((48, 64), config.grey, np.uint8)

    def latest(self, max_age_s: float | None = None) -> Stamped[Frame]:
        now_ns = self._clock.now_ns()
        seq = now_ns // self._period_ns
        frame = Stamped(Frame(self._image), seq * self._period_ns, seq)
        if max_age_s is not None and frame.age_s(now_ns) > max_age_s:
            raise StaleData(self.name, frame.age_s(now_ns), max_age_s, seq)
        return frame

    def next(self, after_seq: int, timeout_s: float) -> Stamped[Frame]:
        self._clock.sleep_until_ns((after_seq + 1) * self._period_ns)
        return self.latest()

    def health(self) -> dict[str, float | int | str | bool]:
        return {"dropped": 0}

    def _open(self) -> None:
        if isinstance(self._scene, Scene) and isinstance(self._arm, SimArm):
            self._scene.mount(self.name, self._arm.T_world_tcp)

    def _close(self) -> None: ...


SPEC = DriverSpec(
    name="acme_camera",
    summary="camera of another package",
    config=AcmeCameraConfig,
    capabilities=Capabilities(
        kind="camera", provides=frozenset({FrameSource, HealthSource}), state_rate_hz=30.0, virtual_time=True
    ),
    build=AcmeCamera,
)
