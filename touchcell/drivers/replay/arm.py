"""Arm that replays the poses at which a labelled data set was collected, in step with a replay camera."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from touchcell.drivers.core.clock import Clock
from touchcell.drivers.core.device import Device, Lifecycle
from touchcell.drivers.core.errors import ConnectError, StaleData
from touchcell.drivers.core.protocols import TcpSource
from touchcell.drivers.core.samples import Stamped, TcpState
from touchcell.drivers.core.spec import Capabilities, DriverConfig, DriverContext, DriverSpec
from touchcell.drivers.replay.dataset import read_split
from touchcell.errors import DataError
from touchcell.geometry import se3
from touchcell.geometry.types import Array
from touchcell.input_file import InputFile


class ReplayArmConfig(DriverConfig):
    """Data set and rate; equal to those of the replay camera.

    Attributes:
        data: root of a data set in the public layout.
        split: train, val or test.
        rate_hz: images per second.
    """

    data: Annotated[Path, InputFile("a data set", folder=True)]
    split: str
    rate_hz: float = Field(default=30.0, gt=0.0, le=1000.0)


class ReplayArm(Device):
    """Replay the sensor pose of each labelled image: ``T_f_s`` of the label, so its base is the surface frame.

    Pose k is reached k periods after ``connect``, in natural order of the images' names like in the replay camera; the
    arm stays at the last.

    Args:
        name: the device's name in the cell.
        config: checked configuration.
        clock: injected clock.
    """

    def __init__(self, name: str, config: ReplayArmConfig, clock: Clock) -> None:
        super().__init__(name, clock)
        self._config = config
        self._period_ns = round(1e9 / config.rate_hz)
        self._start_ns = 0
        self._poses: Array = np.empty((0, 4, 4))

    def tcp(self, max_age_s: float | None = None) -> Stamped[TcpState]:
        """Return the pose of the newest image. Raises StaleData."""
        self._require("read its pose", Lifecycle.PASSIVE, Lifecycle.READY, Lifecycle.ACTIVE)
        now_ns = self._clock.now_ns()
        seq = min((now_ns - self._start_ns) // self._period_ns, len(self._poses) - 1)
        t_ns = self._start_ns + seq * self._period_ns
        if max_age_s is not None and (age_s := (now_ns - t_ns) * 1e-9) > max_age_s:
            raise StaleData(self.name, age_s, max_age_s, seq)
        return Stamped(TcpState(self._poses[seq].copy(), np.zeros(6)), t_ns, seq)

    def _open(self) -> None:
        try:
            split = read_split(self._config.data, self._config.split).in_order()
        except DataError as error:
            raise ConnectError(self.name, "the data set cannot be read", [error]) from None
        self._poses = se3.from_euler_mm_deg(split.contact_mm_deg)
        self._start_ns = self._clock.now_ns()

    def _close(self) -> None:
        self._poses = np.empty((0, 4, 4))


def _build(name: str, config: ReplayArmConfig, context: DriverContext) -> ReplayArm:
    return ReplayArm(name, config, context.clock)


SPEC = DriverSpec(
    name="replay_arm",
    summary="replays the poses at which a labelled data set was collected",
    config=ReplayArmConfig,
    capabilities=Capabilities(kind="arm", provides=frozenset({TcpSource}), state_rate_hz=30.0, virtual_time=True),
    build=_build,
)
