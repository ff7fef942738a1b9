"""The ``truth:`` section: what a simulated world truly is, apart from what tasks and controllers assume.

Each value is a number or a distribution, which is sampled by the cell's seed: every key has a random stream of its own,
so that adding one leaves the others as they are. What was sampled replaces keys of the scene and of simulated drivers;
the file's own sections stay what the controllers believe.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Final, Literal, TypeAlias

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from touchcell.geometry import se3


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, defer_build=True)


class Uniform(_Section):
    """A number anywhere between two others.

    Attributes:
        uniform: smallest and largest value.
    """

    uniform: tuple[float, float]

    @model_validator(mode="after")
    def _ordered(self) -> Uniform:
        if self.uniform[0] > self.uniform[1]:
            raise ValueError(f"uniform: {self.uniform[0]:g} is larger than {self.uniform[1]:g}")
        return self

    def sample(self, rng: np.random.Generator) -> float:
        """Return a sample."""
        return float(rng.uniform(*self.uniform))


class Normal(_Section):
    """A normally distributed number, cut off at three standard deviations.

    Attributes:
        normal: mean and standard deviation.
    """

    normal: tuple[float, float]

    @model_validator(mode="after")
    def _not_negative(self) -> Normal:
        if self.normal[1] < 0.0:
            raise ValueError(f"normal: the standard deviation {self.normal[1]:g} is negative")
        return self

    def sample(self, rng: np.random.Generator) -> float:
        """Return a sample."""
        mean, deviation = self.normal
        return float(mean + deviation * np.clip(rng.standard_normal(), -3.0, 3.0))


class Choice(_Section):
    """One of several values, each as likely as the others.

    Attributes:
        choice: the values.
    """

    choice: tuple[float | str, ...] = Field(min_length=1)

    def sample(self, rng: np.random.Generator) -> float | str:
        """Return one of them."""
        return self.choice[int(rng.integers(len(self.choice)))]


Number: TypeAlias = float | Uniform | Normal | Choice
"""A number, or a distribution of numbers."""
Six: TypeAlias = tuple[Number, Number, Number, Number, Number, Number]
Two: TypeAlias = tuple[Number, Number]

_OFFSETS: Final = {"base_offset_mm_deg": "base_pose_mm_deg", "mount_offset_mm_deg": "tcp_to_sensor_mm_deg"}
_NONE: Final = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


class ArmTruth(_Section):
    """How an arm differs from what the cell declares. All but ``base_offset_mm_deg`` are keys of ``sim_arm``.

    Attributes:
        base_offset_mm_deg: true pose of the base in the frame in which it is told to stand.
        latency_ms: delay of twists.
        lag_ms: time constant with which the arm follows its twist.
        velocity_step_mm_s: resolution of its velocity.
        velocity_step_deg_s: resolution of its angular velocity.
    """

    base_offset_mm_deg: Six = _NONE
    latency_ms: Number | None = None
    lag_ms: Number | None = None
    velocity_step_mm_s: Number | None = None
    velocity_step_deg_s: Number | None = None


class SensorTruth(_Section):
    """How a sensor differs from what the cell declares. All but ``mount_offset_mm_deg`` are keys of ``sim_tactip``.

    Attributes:
        mount_offset_mm_deg: true pose of the sensor in the frame in which the cell declares it.
        tip: tip file, or the name of one that ships.
        rate_hz: frames per second.
        latency_ms: time from exposure to delivery.
        noise: standard deviation of the grey levels, of 255.
        exposure: factor on grey levels.
        blur_px: standard deviation of a Gaussian blur.
        dropped: share of frames that are lost.
        shift_px: shift of the image along x and y.
        zoom: magnification of the image.
        camera_tilt_deg: tilt of the camera about x and y.
    """

    mount_offset_mm_deg: Six = _NONE
    tip: str | Choice | None = None
    rate_hz: Number | None = None
    latency_ms: Number | None = None
    noise: Number | None = None
    exposure: Number | None = None
    blur_px: Number | None = None
    dropped: Number | None = None
    shift_px: Two | None = None
    zoom: Number | None = None
    camera_tilt_deg: Two | None = None


class TipTruth(_Section):
    """Contact law of every tip; keys of ``scene.tip``.

    Attributes:
        radius_mm: radius of the tip.
        stiffness_n_mm: normal stiffness.
        friction: of the skin.
        slip_at_1mm_mm: shear that survives at 1 mm depth.
        slip_exponent: growth of that shear with depth.
    """

    radius_mm: Number | None = None
    stiffness_n_mm: Number | None = None
    friction: Number | None = None
    slip_at_1mm_mm: Number | None = None
    slip_exponent: Number | None = None


class ObjectTruth(_Section):
    """A free object; all but ``pose_offset_mm_deg`` are keys of ``scene.objects.NAME``.

    Attributes:
        mass_g: mass.
        friction: coefficient of sliding friction on the table.
        center_of_mass_mm: x and y of its centre of mass, from the object's origin.
        pose_offset_mm_deg: true initial pose in the frame of the one in the scene.
    """

    mass_g: Number | None = None
    friction: Number | None = None
    center_of_mass_mm: Two | None = None
    pose_offset_mm_deg: Six = _NONE


class TableTruth(_Section):
    """The table; keys of ``scene.table``.

    Attributes:
        friction: coefficient of sliding friction.
        tilt_deg: tilt about x and y.
    """

    friction: Number | Literal["mdf", "foam"] | None = None
    tilt_deg: Two | None = None


class TruthSection(_Section):
    """What a simulated world truly is, where that differs from what the cell declares. Each value is a number, or
    a distribution that the cell's seed samples: ``{uniform: [low, high]}``, ``{normal: [mean, deviation]}`` (cut off
    at three deviations) or ``{choice: [...]}``.

    Attributes:
        arms: by name of the arm.
        sensors: by name of the sensor.
        tip: contact law of every tip.
        objects: by name of the object in the scene.
        table: the table under the objects.
    """

    arms: dict[str, ArmTruth] = {}
    sensors: dict[str, SensorTruth] = {}
    tip: TipTruth = TipTruth()
    objects: dict[str, ObjectTruth] = {}
    table: TableTruth = TableTruth()


@dataclass(frozen=True)
class SampledTruth:
    """What a seed made of a ``truth:`` section.

    Attributes:
        values: what was sampled, by dotted key: numbers, names and lists of numbers.
    """

    values: Mapping[str, Any] = field(default_factory=dict)

    def device(self, kind: str, name: str, config: Mapping[str, Any]) -> dict[str, Any]:
        """Return the keys of a simulated driver that the truth replaces.

        Args:
            kind: ``arms`` or ``sensors``.
            name: of the device.
            config: its keys as the file has them.
        """
        found = self._at(f"{kind}.{name}.")
        for offset, key in (
            ("base_offset_mm_deg", "base_pose_mm_deg"),
            ("mount_offset_mm_deg", "tcp_to_sensor_mm_deg"),
        ):
            if (moved := found.pop(offset, None)) is not None:
                found[key] = _moved(config.get(key, _NONE), moved)
        return found

    def scene(self, scene: Mapping[str, Any]) -> dict[str, Any]:
        """Return the ``scene:`` section with what the truth replaces."""
        true = dict(scene)
        for part in ("tip", "table"):
            if changes := self._at(f"{part}."):
                true[part] = {**true.get(part, {}), **changes}
        objects = dict(true.get("objects", {}))
        for name, section in objects.items():
            if changes := self._at(f"objects.{name}."):
                if (moved := changes.pop("pose_offset_mm_deg", None)) is not None:
                    changes["pose_mm_deg"] = _moved(section.get("pose_mm_deg", _NONE), moved)
                objects[name] = {**section, **changes}
        if objects:
            true["objects"] = objects
        return true

    def _at(self, prefix: str) -> dict[str, Any]:
        return {key.removeprefix(prefix): value for key, value in self.values.items() if key.startswith(prefix)}


def sample(truth: TruthSection, seed: int) -> SampledTruth:
    """Return what ``seed`` makes of ``truth``: the same for the same key and seed, whatever other keys exist."""
    return SampledTruth(dict(_sampled(truth, "", seed)))


def _sampled(section: BaseModel, prefix: str, seed: int) -> Iterator[tuple[str, Any]]:
    for name in type(section).model_fields:
        value, key = getattr(section, name), f"{prefix}{name}"
        if isinstance(value, Mapping):
            for each, inner in value.items():
                yield from _sampled(inner, f"{key}.{each}.", seed)
        elif isinstance(value, Uniform | Normal | Choice):
            yield key, value.sample(_stream(key, seed))
        elif isinstance(value, BaseModel):
            yield from _sampled(value, f"{key}.", seed)
        elif isinstance(value, tuple):
            if value != _NONE:
                yield key, [_one(each, f"{key}.{index}", seed) for index, each in enumerate(value)]
        elif value is not None:
            yield key, value


def _one(value: float | Uniform | Normal | Choice, key: str, seed: int) -> Any:
    return value if isinstance(value, float) else value.sample(_stream(key, seed))


def _stream(key: str, seed: int) -> np.random.Generator:
    return np.random.default_rng((seed, zlib.crc32(key.encode())))


def _moved(pose_mm_deg: Any, offset_mm_deg: Any) -> list[float]:
    T = se3.compose(se3.from_euler_mm_deg(np.array(pose_mm_deg)), se3.from_euler_mm_deg(np.array(offset_mm_deg)))
    return [float(value) for value in se3.to_euler_mm_deg(T)]
