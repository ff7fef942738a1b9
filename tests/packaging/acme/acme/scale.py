"""A kind of device of its own: a force sensor at the wrist, which can be zeroed by a setting."""

from collections.abc import Mapping

from touchcell.drivers.core.device import Device
from touchcell.drivers.core.errors import CommandRejected, Rejection, StaleData
from touchcell.drivers.core.protocols import ReadingSource, SettingSink, StopCategory, Stoppable, TcpSource
from touchcell.drivers.core.samples import Stamped
from touchcell.drivers.core.spec import Capabilities, DriverConfig, DriverContext, DriverSpec


class ScaleConfig(DriverConfig):
    """Keys of a device with this driver: a spring that is compressed below a height of its arm's tool."""

    mounted_on: str
    stiffness_n_mm: float
    free_height_mm: float


class Scale(Device):
    """Measures the force on a spring under its arm's tool."""

    def __init__(self, name: str, config: ScaleConfig, context: DriverContext) -> None:
        super().__init__(name, context.clock)
        self._config = config
        arm = context.devices[config.mounted_on]
        assert isinstance(arm, TcpSource)
        self._arm = arm
        self._zero_n = 0.0
        self.stopped = False

    def read(self, max_age_s: float | None = None) -> Stamped[Mapping[str, float]]:
        state = self._arm.tcp()
        if max_age_s is not None and state.age_s(self._clock.now_ns()) > max_age_s:
            raise StaleData(self.name, state.age_s(self._clock.now_ns()), max_age_s, state.seq)
        compressed_mm = max(0.0, self._config.free_height_mm - 1e3 * float(state.value.T_base_tcp[2, 3]))
        force_n = self._config.stiffness_n_mm * compressed_mm - self._zero_n
        return Stamped({"force_n": force_n}, state.t_ns, state.seq)

    def apply(self, setting: Mapping[str, float]) -> None:
        if set(setting) != {"zero_n"}:
            raise CommandRejected(self.name, Rejection.LIMIT, f"knows only zero_n, not {', '.join(setting)}")
        self._zero_n = setting["zero_n"]

    def stop(self, category: StopCategory = StopCategory.STOP_AND_HOLD) -> None:
        self.stopped = True

    def at_rest(self) -> bool:
        return True

    def _open(self) -> None: ...

    def _close(self) -> None: ...


SPEC = DriverSpec(
    name="acme_scale",
    summary="force sensor of another package",
    config=ScaleConfig,
    capabilities=Capabilities(
        kind="force sensor",
        provides=frozenset({ReadingSource, SettingSink, Stoppable}),
        state_rate_hz=500.0,
        virtual_time=True,
    ),
    build=Scale,
)
