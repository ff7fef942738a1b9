"""Simulated stand-in for a real camera: a TacTip in the scene, at the rate and size of that camera."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from touchcell.drivers.core.behaviour import CameraBehaviour
from touchcell.drivers.core.samples import Frame
from touchcell.drivers.core.spec import AnyDriver, DriverConfig, DriverContext
from touchcell.drivers.core.stand_in import Placement
from touchcell.errors import ConfigError
from touchcell.geometry.types import Array
from touchcell.simulation.devices import tactip
from touchcell.simulation.devices.tactip import SimTactip, SimTactipConfig
from touchcell.simulation.scene import Scene


class StandInCamera(SimTactip):
    """Driver of a simulated camera that delivers pictures as another driver's."""

    size_px = (640, 480)
    color = False

    def _expose(self, seq: int, t_ns: int) -> Frame:
        image = super()._expose(seq, t_ns).image
        if (image.shape[1], image.shape[0]) != self.size_px:
            image = cv2.resize(image, self.size_px, interpolation=cv2.INTER_AREA).astype(np.uint8)
        if self.color:
            image = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR).astype(np.uint8)
        image.flags.writeable = False
        return Frame(image)


class _Still:
    """Carrier of a camera that no arm carries: the frame of the world, facing up."""

    def T_world_tcp(self) -> Array:  # noqa: N802  standard notation for transforms
        """Return the identity (4, 4)."""
        return np.eye(4)


def stand_in(spec: AnyDriver, placement: Placement) -> AnyDriver:
    """Return a simulated driver with the name, configuration and capabilities of ``spec``.

    Raises (when it builds):
        ConfigError: the driver describes no behaviour, or the arm that carries the camera is not there.
    """
    able = replace(spec.capabilities, virtual_time=True, needs_scene=True, hardware_validated=False)

    def build(name: str, config: DriverConfig, context: DriverContext) -> SimTactip:
        behaviour = None if spec.behaviour is None else spec.behaviour(config)
        if not isinstance(behaviour, CameraBehaviour):
            raise ConfigError(
                f"{spec.name} describes no behaviour to simulate", key=f"sensors.{name}.driver", value=spec.name
            )
        settings = SimTactipConfig(
            mounted_on=placement.mounted_on or "",
            tcp_to_sensor_mm_deg=placement.tcp_to_sensor_mm_deg,
            rate_hz=behaviour.rate_hz,
            latency_ms=1e3 * behaviour.latency_s,
            feels="shape" if isinstance(context.scene, Scene) and context.scene.feels_shape else "plane",
        )
        if placement.mounted_on is None:
            context = replace(context, devices={"": _Still()})  # type: ignore[dict-item]
        camera = tactip.build(name, settings, context, StandInCamera)
        camera.size_px = behaviour.width_px, behaviour.height_px
        camera.color = behaviour.color
        return camera

    return replace(spec, summary=f"simulated: {spec.summary}", capabilities=able, build=build)
