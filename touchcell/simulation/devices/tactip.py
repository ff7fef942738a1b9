"""Driver of a simulated TacTip: camera frames of the markers of a tip that an arm carries through the scene."""

from __future__ import annotations

import math
import zlib
from dataclasses import replace
from typing import Annotated, Literal, TypeVar

import numpy as np
from pydantic import Field

from touchcell.drivers.core.clock import Clock
from touchcell.drivers.core.device import Device, Lifecycle
from touchcell.drivers.core.errors import StaleData, TransportTimeout
from touchcell.drivers.core.protocols import FrameSource, HealthSource, TcpSource
from touchcell.drivers.core.samples import Frame, Stamped
from touchcell.drivers.core.spec import Capabilities, DriverConfig, DriverContext, DriverSpec
from touchcell.errors import ConfigError
from touchcell.geometry import se3
from touchcell.input_file import InputFile, files_in
from touchcell.simulation.faults import FrameFaults
from touchcell.simulation.render import FrameRenderer, Lighting
from touchcell.simulation.scene import Carrier, LoadReceiver, MeasuredCarrier, Scene
from touchcell.simulation.tip import Tip, TipParameters
from touchcell.simulation.tip_file import SHIPPED as TIPS
from touchcell.simulation.tip_file import load_tip

CAPABILITIES = Capabilities(
    kind="camera",
    provides=frozenset({FrameSource, HealthSource}),
    state_rate_hz=30.0,
    virtual_time=True,
    needs_scene=True,
)

_READABLE = (Lifecycle.PASSIVE, Lifecycle.READY, Lifecycle.ACTIVE)


SensorT = TypeVar("SensorT", bound="SimTactip")


class SimTactipConfig(DriverConfig):
    """Mount and camera of the sensor.

    ``exposure`` is a factor on grey levels, ``blur_px`` the standard deviation of a Gaussian, ``dropped`` the fraction
    of frames lost, ``tip`` a tip file (``touchcell calibrate-sim``) or the name of one that ships. Exposure, blur and
    noise apply to ``output: raw``; processed images are black and white.

    Attributes:
        mounted_on: name of the arm that carries it.
        tcp_to_sensor_mm_deg: pose of the sensor in the tool frame of that arm.
        rate_hz: frames per second.
        latency_ms: time from exposure to delivery.
        noise: standard deviation of the grey levels, of 255.
        exposure: factor on grey levels.
        blur_px: standard deviation of a Gaussian blur.
        dropped: share of frames that are lost.
        tip: tip file of ``touchcell calibrate-sim``, or the name of one that ships.
        feels: ``plane`` draws the skin as on the tangent plane of what it touches, on which the shipped estimator was
            trained; ``shape`` adds what curvature, edges and pins change (docs/explanation/shapes.md).
        shift_px: shift of the whole image along x and y.
        zoom: magnification of the image.
        camera_tilt_deg: tilt of the camera about the sensor's x and y axes, in addition to that of ``tip``.
        output: ``raw`` camera frames, or ``processed`` binary images as in the public data.
    """

    mounted_on: str
    tcp_to_sensor_mm_deg: tuple[float, float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    rate_hz: float = Field(default=30.0, ge=1.0, le=500.0)
    latency_ms: float = Field(default=10.0, ge=0.0, le=1000.0)
    noise: float = Field(default=2.0, ge=0.0, le=40.0)
    exposure: float = Field(default=1.0, gt=0.0, le=10.0)
    blur_px: float = Field(default=0.0, ge=0.0, le=20.0)
    dropped: float = Field(default=0.0, ge=0.0, le=0.9)
    tip: Annotated[
        str | None,
        InputFile("a tip file", files_in(TIPS, ".yaml"), hint="`touchcell calibrate-sim` writes one"),
    ] = None
    shift_px: tuple[float, float] = (0.0, 0.0)
    zoom: float = Field(default=1.0, ge=0.5, le=2.0)
    camera_tilt_deg: tuple[float, float] = (0.0, 0.0)
    output: Literal["raw", "processed"] = "raw"
    feels: Literal["plane", "shape"] = "plane"

    def build_tip(self) -> Tip:
        """Return the tip as this sensor's camera shows it."""
        fitted = TipParameters() if self.tip is None else load_tip(self.tip).tip
        return Tip(
            replace(
                fitted,
                centre_px=(fitted.centre_px[0] + self.shift_px[0], fitted.centre_px[1] + self.shift_px[1]),
                focal_px=self.zoom * fitted.focal_px,
                disc_radius_px=self.zoom * fitted.disc_radius_px,
                camera_tilt_rad=(
                    fitted.camera_tilt_rad[0] + math.radians(self.camera_tilt_deg[0]),
                    fitted.camera_tilt_rad[1] + math.radians(self.camera_tilt_deg[1]),
                ),
            )
        )


class SimTactip(Device):
    """Driver of a simulated sensor.

    Frames are exposed at whole multiples of the period on the clock, whether or not they are read, and carry that time;
    frame k has ``seq`` k. They become available ``latency_ms`` later and are rendered on demand. ``faults`` may be set
    at any time.

    Args:
        name: the device's name in the cell and in the scene.
        config: checked configuration.
        clock: injected clock.
        scene: scene that it touches.
        mount: arm that carries it.
        seed: seed of the noise; the same seed and frame give the same image.
    """

    def __init__(
        self,
        name: str,
        config: SimTactipConfig,
        clock: Clock,
        scene: Scene,
        mount: Carrier,
        seed: int = 0,
    ) -> None:
        super().__init__(name, clock)
        self.faults = FrameFaults()
        self._scene = scene
        self._processed = config.output == "processed"
        self._feels_shape = config.feels == "shape"
        self._period_ns = round(1e9 / config.rate_hz)
        self._latency_ns = round(config.latency_ms * 1e6)
        self._first = 0
        self._tip = config.build_tip()
        self._dropped = config.dropped
        self._seed = (seed, zlib.crc32(name.encode()))
        self._renderer = FrameRenderer(
            self._tip.parameters.disc_radius_px,
            Lighting(noise=config.noise, exposure=config.exposure, blur_px=config.blur_px),
            seed=self._seed,
        )
        self._newest: Stamped[Frame] | None = None
        self._drawn = 0
        self._mount = mount
        self._T_tcp_s = se3.from_euler_mm_deg(config.tcp_to_sensor_mm_deg)
        scene.timeline.keep(lambda: self._discard_image)
        if not isinstance(mount, MeasuredCarrier):
            self._touch()

    def latest(self, max_age_s: float | None = None) -> Stamped[Frame]:
        """Return the newest frame; wait for the very first. Raises StaleData if it is older than ``max_age_s``."""
        self._require("deliver frames", *_READABLE)
        self._clock.sleep_until_ns(self._available_ns(self._next_delivered(self._first)))
        now_ns = self._clock.now_ns()
        seq = self._newest_seq(now_ns)
        age_s = (now_ns - seq * self._period_ns) * 1e-9
        if max_age_s is not None and age_s > max_age_s:
            raise StaleData(self.name, age_s, max_age_s, seq)
        return self._draw(seq)

    def next(self, after_seq: int, timeout_s: float) -> Stamped[Frame]:
        """Return the newest frame if its ``seq > after_seq``, else wait for the next. Raises TransportTimeout."""
        self._require("deliver frames", *_READABLE)
        now_ns = self._clock.now_ns()
        seq = self._next_delivered(max(self._newest_seq(now_ns), after_seq + 1, self._first))
        deadline_ns = now_ns + round(timeout_s * 1e9)
        if self._available_ns(seq) > deadline_ns or self._is_never_delivered(seq):
            self._clock.sleep_until_ns(deadline_ns)
            raise TransportTimeout(self.name, f"frame after {after_seq}", timeout_s)
        self._clock.sleep_until_ns(self._available_ns(seq))
        return self._draw(seq)

    def health(self) -> dict[str, float | int | str | bool]:
        """Return the number of rendered frames."""
        return {"frames_drawn": self._drawn, "rate_hz": 1e9 / self._period_ns}

    def _available_ns(self, seq: int) -> int:
        return seq * self._period_ns + self._delay_ns()

    def _delay_ns(self) -> int:
        return self._latency_ns + round(self.faults.extra_latency_s * 1e9)

    def _newest_seq(self, now_ns: int) -> int:
        seq = (now_ns - self._delay_ns()) // self._period_ns
        if self.faults.last_seq is not None:
            seq = min(seq, self.faults.last_seq)
        while seq > self._first and not self._is_delivered(seq):
            seq -= 1
        return seq

    def _next_delivered(self, seq: int) -> int:
        """Return the number of the first frame that is not dropped, from ``seq`` on."""
        while not self._is_delivered(seq):
            seq += 1
        return seq

    def _is_delivered(self, seq: int) -> bool:
        """Return whether frame ``seq`` is not dropped: the same for the same seed."""
        return not self._dropped or np.random.default_rng((*self._seed, max(seq, 0), 1)).random() >= self._dropped

    def _is_never_delivered(self, seq: int) -> bool:
        return self.faults.last_seq is not None and seq > self.faults.last_seq

    def _draw(self, seq: int) -> Stamped[Frame]:
        if self._newest is None or self._newest.seq != seq:
            t_ns = seq * self._period_ns
            frame = self._newest.value if self._newest and self.faults.frozen else self._expose(seq, t_ns)
            self._newest = Stamped(frame, t_ns, seq)
        return self._newest

    def _expose(self, seq: int, t_ns: int) -> Frame:
        relief = self._scene.relief(self.name, self._tip.relief.directions, t_ns) if self._feels_shape else None
        pixels = self._tip.pixels(self._scene.contact(self.name, t_ns).value.T_f_s, relief)
        image = self._renderer.processed(pixels) if self._processed else self._renderer.raw(pixels, seq)
        if self.faults.gain != 1.0:
            image = np.clip(image * self.faults.gain, 0.0, 255.0).astype(np.uint8)
        image.flags.writeable = False
        self._drawn += 1
        return Frame(image)

    def _discard_image(self, later_ns: int) -> None:
        """Discard the newest image, which may show a state that a restored scene has undone."""
        self._newest = None

    def _open(self) -> None:
        self._scene.timeline.advance()
        if not self._scene.has(self.name):
            self._touch()

    def _touch(self) -> None:
        mount, T_tcp_s = self._mount, self._T_tcp_s
        apply_force = mount.apply_force if isinstance(mount, LoadReceiver) else None
        self._scene.mount(self.name, lambda: mount.T_world_tcp() @ T_tcp_s, apply_force)
        self._first = math.ceil(self._scene.timeline.t_ns / self._period_ns)

    def _close(self) -> None:
        self._newest = None


def _build(name: str, config: SimTactipConfig, context: DriverContext) -> SimTactip:
    return build(name, config, context, SimTactip)


def build(name: str, config: SimTactipConfig, context: DriverContext, sensor_type: type[SensorT]) -> SensorT:
    """Return a DISCONNECTED sensor of ``sensor_type``. Raises ConfigError without a scene or an arm that carries it."""
    scene: object = context.scene
    arm: object = context.devices.get(config.mounted_on)
    mount: object = arm
    if not isinstance(arm, Carrier) and isinstance(arm, TcpSource):
        mount = MeasuredCarrier(arm, context.bases.get(config.mounted_on, np.eye(4)))
    if not isinstance(scene, Scene):
        raise ConfigError("a simulated sensor needs a scene", key=name, hint="add a scene: section to the cell file")
    if not isinstance(mount, Carrier):
        raise ConfigError(
            f"{config.mounted_on!r} is not an arm of this cell",
            key=f"{name}.mounted_on",
            value=config.mounted_on,
            hint=f"devices so far: {', '.join(context.devices) or 'none'}",
        )
    return sensor_type(name, config, context.clock, scene, mount, context.seed)


SPEC = DriverSpec(
    name="sim_tactip",
    summary="simulated TacTip on an arm, in a simulated scene",
    config=SimTactipConfig,
    capabilities=CAPABILITIES,
    build=_build,
)
