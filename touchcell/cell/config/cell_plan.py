"""The sections of a cell file, and the plan that is made of a file that makes sense."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self

import yaml
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, NonNegativeInt, PositiveFloat, model_validator

from touchcell.cell.config.layers import load_layers
from touchcell.cell.config.stopping_distance import StoppingDistance
from touchcell.cell.config.truth import TruthSection
from touchcell.control.interlocks.config import InterlocksConfig
from touchcell.control.proof import Proof
from touchcell.drivers.core.device import DeactivatePolicy
from touchcell.drivers.core.spec import AnyDriver, DriverConfig
from touchcell.errors import ConfigError
from touchcell.geometry import se3
from touchcell.geometry.types import Array
from touchcell.perception.runtime.estimator_spec import EstimatorSection
from touchcell.tasks.interface import AnyTask, TaskConfig

Three = tuple[float, float, float]
Six = tuple[float, float, float, float, float, float]


REDUCED_SPEED_M_S: Final = 0.25
"""Largest speed of the tool centre point in reduced-speed mode (ISO 10218-1:2025, 5.5.6)."""
_LONGEST_NAME: Final = 100


def _folder_name(name: str) -> str:
    """A cell's name, which names its run folders too."""
    if not re.fullmatch(r"\w[\w .+-]*", name) or len(name.encode()) > _LONGEST_NAME:
        raise ValueError(
            "names run folders: it may have letters, digits, spaces, `.`, `_`, `+` and `-`, begins with a letter or "
            f"digit, and has at most {_LONGEST_NAME} bytes"
        )
    return name


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, defer_build=True)


class OpenSection(BaseModel):
    """A section whose other keys belong to the driver or task that it names."""

    model_config = ConfigDict(extra="allow", frozen=True, allow_inf_nan=False, defer_build=True)


class CapsuleSection(_Section):
    """A part of an arm: all within ``radius_mm`` of a segment from ``from_mm`` to ``to_mm`` in the tool's frame.

    ``from_base_mm`` in place of ``from_mm`` is a place in the base's frame: for the forearm of an arm that reports only
    where its tool is.

    Attributes:
        from_mm: start of the segment in the tool's frame.
        from_base_mm: start of the segment in the base's frame, in place of ``from_mm``.
        to_mm: end of the segment in the tool's frame.
        radius_mm: radius of the capsule.
    """

    from_mm: Three | None = None
    from_base_mm: Three | None = None
    to_mm: Three
    radius_mm: PositiveFloat

    @model_validator(mode="after")
    def _one_start(self) -> Self:
        if (self.from_mm is None) == (self.from_base_mm is None):
            raise ValueError("say either from_mm or from_base_mm")
        return self


class BoxSection(_Section):
    """Something that stands still: the pose of its centre in the world, and the lengths of its sides.

    Attributes:
        pose_mm_deg: pose of its centre in the world frame.
        size_mm: lengths of its sides.
    """

    pose_mm_deg: Six
    size_mm: tuple[PositiveFloat, PositiveFloat, PositiveFloat]


class ArmSection(OpenSection):
    """An arm: its driver, where it stands, what it looks like, what happens when it is deactivated or has to stop, and
    the driver's own keys.

    ``stop_category`` is by IEC 60204-1: 2 stops and holds with power, 1 stops and then removes it. ``base_pose_mm_deg``
    is in the world; ``body`` adds capsules to those of the arm's chain, for ``clearance``.

    Attributes:
        driver: name of the driver, as ``touchcell list`` shows it.
        deactivate: what the arm does when it is deactivated at the end of a run, once it stands.
        stop_category: how it stops when something is wrong, by IEC 60204-1: 2 stops and holds with power, 1 stops and
            then removes it.
        base_pose_mm_deg: pose of its base in the world frame.
        body: capsules in addition to those of the arm's chain, for ``clearance``.
        start_pose_mm_deg: initial pose of the tool in the base frame, where a simulation or an emulator puts it; a real
            arm starts where it is.
    """

    driver: str
    deactivate: DeactivatePolicy
    stop_category: Literal[1, 2] = 2
    base_pose_mm_deg: Six = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    body: tuple[CapsuleSection, ...] = ()
    start_pose_mm_deg: Six | None = None

    @property
    def T_world_base(self) -> Array:  # noqa: N802  the field's own name
        """(4, 4) where it stands."""
        return se3.from_euler_mm_deg(self.base_pose_mm_deg)


class SensorSection(OpenSection):
    """A tactile sensor: its camera's driver, where it sits, and how frames become contacts.

    Attributes:
        driver: name of the camera's driver, as ``touchcell list`` shows it.
        mounted_on: name of the arm that carries it; none where nothing moves it.
        tcp_to_sensor_mm_deg: pose of the sensor in the tool frame of that arm.
        estimator: how frames become contacts.
    """

    driver: str
    mounted_on: str | None = None
    tcp_to_sensor_mm_deg: Six = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    estimator: EstimatorSection

    @property
    def T_tcp_sensor(self) -> Array:  # noqa: N802  the field's own name
        """(4, 4) where it sits on the tool."""
        return se3.from_euler_mm_deg(self.tcp_to_sensor_mm_deg)


class DeviceSection(OpenSection):
    """A device that is neither an arm nor a tactile sensor, as a force-torque sensor or a gripper: its driver, the arm
    that carries it, what happens when it is deactivated, and the driver's own keys.

    Attributes:
        driver: name of the driver, as ``touchcell list`` shows it.
        mounted_on: name of the arm that carries it; none where nothing moves it.
        deactivate: what it does when it is deactivated.
    """

    driver: str
    mounted_on: str | None = None
    deactivate: DeactivatePolicy = DeactivatePolicy.HOLD


class TaskSection(OpenSection):
    """The task, which arms, sensors and devices play its roles, and the task's own keys.

    ``steps:`` alone names the task too.

    Attributes:
        name: name of the task, as ``touchcell list`` shows it.
        arms: name of the arm that plays each role; a role that is left out goes to the arm of its name.
        sensors: name of the sensor that plays each role, likewise.
        devices: name of the device that plays each role, likewise.
    """

    name: str
    arms: dict[str, str] = {}
    sensors: dict[str, str] = {}
    devices: dict[str, str] = {}

    @model_validator(mode="before")
    @classmethod
    def _named_by_its_steps(cls, section: Any) -> Any:
        return {"name": "steps", **section} if isinstance(section, dict) and "steps" in section else section


class RecordingSection(_Section):
    """What is kept of a run besides numbers.

    Attributes:
        frames: whether camera images are recorded, and how they are compressed: ``video`` is H.264 (needs the extra
            ``video``), ``jpeg`` keeps each image by itself, ``png`` loses nothing.
    """

    frames: Literal["none", "video", "jpeg", "png"] = "none"


class PairSection(_Section):
    """Two arms with something between them.

    All arms of a cell stop together. With ``on_stop: hold`` the follower then keeps its power, and so what it holds,
    whatever its ``stop_category`` says, unless it is itself what is wrong; with ``same`` it stops as that says.

    Attributes:
        leader: name of the arm that pushes.
        follower: name of the arm that gives way and holds.
        on_stop: what the follower does when all arms stop: ``hold`` keeps its power, ``same`` obeys its
            ``stop_category``.
    """

    leader: str
    follower: str
    on_stop: Literal["hold", "same"] = "hold"


class CollectSection(_Section):
    """Where labelled frames go, and in which proportion to which split.

    Attributes:
        data: folder of the data set, made or continued.
        shares: proportion of the frames that go to each split.
    """

    data: Path
    shares: dict[Literal["train", "val", "test"], Annotated[int, Field(ge=1)]] = Field(
        default={"train": 3, "val": 1}, min_length=1
    )


class CellFile(_Section):
    """A whole cell file.

    ``on_trip: end`` ends a run that has tripped; ``wait_for_reset`` keeps it up, with the arms stopped and watched,
    until a person has reset it and lets the task start again. ``emulated_scene`` is what `touchcell emulate cell` puts
    around the cell's arms and cameras; nothing else reads it.

    Attributes:
        schema_: version of the format; 1.
        name: name of the cell, which names its run folders.
        world: ``sim`` puts simulated stand-ins in place of real drivers, ``emulated`` runs them on emulators, ``bench``
            refuses all that is simulated; ``--on`` sets it.
        emulated_pace: seconds that pass in the emulated world in each second of the machine: less than 1 on a machine
            that is too busy, or has too few cores, to run a cell and its emulators in real time.
        time: ``simulated`` runs as fast as it can on a virtual clock, ``real`` in real time.
        rate_hz: control cycles per second.
        processes: ``separate`` runs devices in processes of their own with a watchdog, in real time only.
        perceive_in: where camera frames become contacts: the ``loop``'s thread, or ``threads`` of their own, one for
            each sensor; ``auto`` takes threads where the frames of all sensors together, at 6 ms each, take more than
            half of a cycle. Simulated cameras are always read in the loop's thread.
        seed: of everything random, from 0 on.
        max_duration_s: longest run; it is stopped then.
        scene: what is simulated around the arms, for simulated devices.
        emulated_scene: what ``touchcell emulate cell`` puts around the cell's arms and cameras; nothing else reads it.
        obstacles: what stands still around the arms, by a name of one's own, for ``clearance``.
        arms: the arms, by a name of one's own.
        sensors: the tactile sensors, by a name of one's own.
        devices: other devices, by a name of one's own.
        pairs: arms that hold something between them.
        interlocks: the rules that stop or slow the arms, by a name of one's own.
        on_trip: what happens after a trip: ``end`` ends the run; ``wait_for_reset`` keeps the arms stopped and watched
            until a person has reset it.
        reduced_speed: True caps every tool at 250 mm/s, in its gate and by an interlock of its own.
        enabling_device: what ``hold_to_run`` reads: ``simulated``, or ``external`` for one that the program that runs
            the cell brings.
        task: what the cell does.
        recording: what is recorded of a run besides numbers.
        collect: where a task that labels frames puts them.
        truth: what the simulated world truly is, where that differs from what this file declares to the controllers.
        sweep: what ``touchcell sweep`` changes from trial to trial; nothing else reads it.
    """

    schema_: Literal[1] = Field(alias="schema")
    name: Annotated[str, AfterValidator(_folder_name)]
    world: Literal["sim", "emulated", "bench"] | None = None
    emulated_pace: float = Field(default=1.0, ge=0.01, le=1.0)
    time: Literal["simulated", "real"]
    rate_hz: Annotated[float, Field(gt=0, le=1000)]
    processes: Literal["one", "separate"] = "one"
    perceive_in: Literal["auto", "loop", "threads"] = "auto"
    seed: NonNegativeInt = 0
    max_duration_s: PositiveFloat = 3600.0
    scene: dict[str, Any] | None = None
    emulated_scene: dict[str, Any] | None = None
    truth: TruthSection | None = None
    obstacles: dict[str, BoxSection] = {}
    arms: dict[str, ArmSection] = {}
    sensors: dict[str, SensorSection] = {}
    devices: dict[str, DeviceSection] = {}
    pairs: tuple[PairSection, ...] = ()
    interlocks: InterlocksConfig = {}
    on_trip: Literal["end", "wait_for_reset"] = "end"
    reduced_speed: bool = False
    enabling_device: Literal["simulated", "external"] | None = None
    task: TaskSection
    recording: RecordingSection = RecordingSection()
    collect: CollectSection | None = None
    sweep: dict[str, Any] | None = None


@dataclass(frozen=True, slots=True)
class DevicePlan:
    """A device that will be built: its section, spec and validated configuration."""

    name: str
    spec: AnyDriver
    config: DriverConfig


@dataclass(frozen=True)
class CellPlan:
    """A cell file that makes sense.

    Attributes:
        file: where it came from.
        cell: the file's own sections.
        arms, sensors: devices that the task needs, by name in the cell.
        arm_roles, sensor_roles: role in the task -> name in the cell.
        task: the task's spec.
        task_config: its validated parameters.
        skipped: devices of the file that this task does not need and that are not built.
        devices: every device of the file, whether the task needs it or not.
        stopping_distances: by the name of a workspace or clearance, how far its arm gets beyond it, or the two fastest
            arms towards each other, before they stand.
        settings: values that were set in place of the file's own, by dotted key.
        proofs: what made each interlock trip.
        auxiliaries: other devices that the task needs or that are read, by name in the cell.
        auxiliary_roles: role in the task -> name in the cell; a device without a role has its own name as role.
        world_settings: values that its world put in place of the file's own, by dotted key, behind ``settings``.
        notes: what its world does not show, what it puts in place of something else, and what a sensor cannot follow.
        foreseen: why each run would trip, as far as the file tells: ``check`` refuses it, a run warns.
        truth: what the seed made of ``truth:``, by dotted key; empty without one.
    """

    file: Path
    cell: CellFile
    arms: Mapping[str, DevicePlan]
    sensors: Mapping[str, DevicePlan]
    arm_roles: Mapping[str, str]
    sensor_roles: Mapping[str, str]
    task: AnyTask
    task_config: TaskConfig
    skipped: tuple[str, ...]
    devices: Mapping[str, DevicePlan]
    stopping_distances: Mapping[str, StoppingDistance] = field(default_factory=dict)
    settings: Mapping[str, Any] = field(default_factory=dict)
    auxiliaries: Mapping[str, DevicePlan] = field(default_factory=dict)
    auxiliary_roles: Mapping[str, str] = field(default_factory=dict)
    proofs: tuple[Proof, ...] = ()
    world_settings: Mapping[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    foreseen: tuple[ConfigError, ...] = ()
    truth: Mapping[str, Any] = field(default_factory=dict)

    def __repr__(self) -> str:
        devices = [f"{name} {device.spec.name}" for name, device in self.built.items()]
        return f"<CellPlan {self.cell.name!r}: task {self.task.name}, {', '.join(devices)}>"

    @property
    def built(self) -> Mapping[str, DevicePlan]:
        """Every device that is built, each after those that it may depend on."""
        return {**self.arms, **self.sensors, **self.auxiliaries}

    def text(self) -> str:
        """The cell file as it is planned: the file itself, or YAML of what comes of it and of what it extends.

        Files of its scene have absolute paths, as a run folder is read from elsewhere.
        """
        merged = load_layers(self.file, self.settings, self.world_settings)
        if not merged.sources and merged.data.get("scene") == self.cell.scene:
            return self.file.read_text()
        data = {key: self.cell.scene if key == "scene" else value for key, value in merged.data.items()}
        return yaml.safe_dump(data, sort_keys=False, allow_unicode=True)
