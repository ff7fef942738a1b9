"""From a plan to running devices: builds only what the task needs, each thing after those that it depends on."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Protocol, Self, cast

import numpy as np

from touchcell.cell.config.schema import (
    CellPlan,
    DevicePlan,
    KnownSurface,
    MovingSurfaceSection,
    NetworkEstimator,
    SensorSection,
    StillSurfaceSection,
)
from touchcell.cell.recording.dataset_writer import Collection
from touchcell.cell.recording.messages import belief_message, pose_message
from touchcell.cell.runtime.known_surface import KnownSurfaceSource
from touchcell.cell.runtime.planning_scene import build_planning_scene
from touchcell.cell.runtime.watchdog import NullWatchdog, Watchdog
from touchcell.control.interlocks.config import build_interlocks
from touchcell.control.latch import Latch
from touchcell.control.supervisor import Supervisor
from touchcell.drivers.core.arm import Arm
from touchcell.drivers.core.clock import Clock, MonotonicClock, VirtualClock
from touchcell.drivers.core.device import Device
from touchcell.drivers.core.protocols import FrameSource, StopCategory, TcpSource
from touchcell.drivers.core.samples import Frame, Stamped
from touchcell.drivers.core.scene import scene_section
from touchcell.drivers.core.spec import DriverContext
from touchcell.errors import ConfigError
from touchcell.geometry import se3
from touchcell.geometry.types import Array
from touchcell.paths import MODELS
from touchcell.perception.runtime.pipeline import ContactPipeline, ContactSource
from touchcell.tasks.interface import Task, TaskContext

if TYPE_CHECKING:
    from touchcell.drivers.core.scene import Scene, SceneTruth
    from touchcell.drivers.hosting.chain import Chain
    from touchcell.perception.runtime.filter import ContactFilter

BUILTIN = "builtin:"


class PoseDevice(TcpSource, Protocol):
    """A device that tells where its tool is: an arm, or the replay of one."""


@dataclass
class Sensor:
    """One tactile sensor in a running cell.

    Attributes:
        source: tells its contact.
        arm_role: role of the arm that carries it, None where nothing moves it.
        T_tcp_sensor: (4, 4) its pose in that arm's tool frame.
        truth: what is known to be true: the simulator's own contact, or the label of a replayed image.
        frames: how images are recorded.
        watched: whether an interlock looks at the pictures.
    """

    source: ContactSource
    arm_role: str | None
    T_tcp_sensor: Array
    truth: ContactSource | None = None
    frames: str = "none"
    watched: bool = False
    _recorded_seq: int = field(default=-1, init=False)
    _picture: tuple[int | None, float | None] = field(default=(None, None), init=False)
    _picture_seq: int = field(default=-1, init=False)

    @property
    def frame(self) -> Stamped[Frame] | None:
        """The newest frame that was looked at; None from a source that looks at none."""
        return self.source.frame if isinstance(self.source, ContactPipeline | KnownSurfaceSource) else None

    def await_frame(self) -> None:
        """Wait for the first frame, so that no control cycle has to. Raises DeviceError."""
        if isinstance(self.source, ContactPipeline | KnownSurfaceSource):
            self.source.await_frame()

    def picture(self) -> tuple[int | None, float | None]:
        """A checksum and the mean grey level of every third pixel of the newest frame; (None, None) if not watched."""
        frame = self.frame if self.watched else None
        if frame is not None and frame.seq != self._picture_seq:
            sample = np.ascontiguousarray(frame.value.image[::3, ::3])
            self._picture = zlib.crc32(sample.data), float(sample.mean())
            self._picture_seq = frame.seq
        return self._picture

    def stage_times(self) -> dict[str, int]:
        """Nanoseconds of each perception stage in this cycle; empty for a source that has none."""
        if not isinstance(self.source, ContactPipeline):
            return {}
        times = self.source.times
        return {
            "read frame": times.read_ns,
            "preprocess": times.preprocess_ns,
            "infer": times.infer_ns,
            "filter": times.filter_ns,
        }

    def about(self) -> dict[str, Any] | None:
        """What recorded images need to be understood: the preprocessing; None when none are recorded."""
        if self.frames == "none" or not isinstance(self.source, ContactPipeline):
            return None
        return self.source.preprocessing.model_dump(mode="json")

    def extra_messages(self, now_ns: int) -> Iterator[tuple[str, int, dict[str, Any]]]:
        """What else is recorded of this sensor in this cycle: the frame's own measurement, its image, the truth."""
        if isinstance(self.source, ContactPipeline):
            measured = self.source.measurement
            if measured is not None and measured.belief is not None:
                yield "measurement", measured.t_ns, {"seq": measured.seq, **belief_message(measured.belief)}
        frame = self.frame
        if self.frames != "none" and frame is not None and frame.seq != self._recorded_seq:
            self._recorded_seq = frame.seq
            yield "image", frame.t_ns, _image_message(frame.value.image, self.frames, frame.seq, frame.t_ns)
        if self.truth is not None:
            true = self.truth.update(now_ns)
            if true is not None:
                message: dict[str, Any] = {"in_contact": true.in_contact}
                if true.belief is not None:
                    message |= pose_message(se3.inverse(true.belief.mean))
                yield "truth", true.t_ns, message


@dataclass
class Cell:
    """A cell that is built. As a context manager it is connected and activated, and given back at the end.

    Attributes:
        plan: where it came from.
        clock: its time.
        arms: by role in the task, and those that only carry a sensor by their own name.
        sensors: by role.
        task: what the cell does.
        new_task: makes it anew, in its first state, after a trip.
        stop_categories: by which each arm stops when something is wrong, by role.
        holding: roles of arms that keep their power when another's fault stops them.
        watched_joints: roles of arms whose joint angles an interlock looks at.
        scene: what is simulated around the arms, as far as it can be looked into; None in a cell of real devices.
        collection: where labelled frames go, None where the task labels none.
        watch: who looks after the loop.
    """

    plan: CellPlan
    clock: Clock
    arms: Mapping[str, Any]
    cameras: Mapping[str, Device]
    sensors: Mapping[str, Sensor]
    supervisor: Supervisor
    task: Task
    new_task: Callable[[], Task]
    stop_categories: Mapping[str, StopCategory] = field(default_factory=dict)
    holding: frozenset[str] = frozenset()
    watched_joints: frozenset[str] = frozenset()
    scene: SceneTruth | None = None
    collection: Collection | None = None
    watch: Watchdog = field(default_factory=NullWatchdog)
    start_ns: int = 0
    _exit: ExitStack = field(default_factory=ExitStack, init=False)

    def __repr__(self) -> str:
        devices = ", ".join(repr(device) for device in self._devices())
        return f"<Cell {self.plan.cell.name!r}: task {self.task_name} in {self.task.state!r}, {devices}>"

    @property
    def rate_hz(self) -> float:
        """Control cycles per second."""
        return self.plan.cell.rate_hz

    @property
    def max_duration_s(self) -> float:
        """Longest run."""
        return self.plan.cell.max_duration_s

    @property
    def task_name(self) -> str:
        """The task's name, which owns the arms' leases."""
        return self.plan.task.name

    def __enter__(self) -> Self:
        with self._exit:
            self._exit.enter_context(self.watch)
            for device in self._devices():
                self._exit.enter_context(device)
                device.configure()
            # Every device must answer before the first one is energised.
            for device in self._devices():
                device.activate()
                self._exit.callback(self._deactivate, device)
            self.watch.prove()
            self.start_ns = self.clock.now_ns()
            self._exit = self._exit.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._exit.close()

    def _devices(self) -> list[Device]:
        unique = {id(device): device for device in [*self.arms.values(), *self.cameras.values()]}
        return list(unique.values())

    def _deactivate(self, device: Device) -> None:
        section = self.plan.cell.arms.get(device.name)
        if device.state.value == "active":
            device.deactivate(section.deactivate) if section is not None else device.deactivate()


def compose(plan: CellPlan, *, clock: Clock | None = None) -> Cell:
    """Build everything that ``plan`` needs; nothing is connected yet.

    Args:
        plan: a checked cell file.
        clock: in place of the one that the file asks for.

    Raises:
        ConfigError: an interlock names what is not there.
        ModelError: a model file cannot be used.
        RecordingError: the folder for labelled frames cannot be written.
    """
    cell_clock = clock or _clock(plan)
    chain = _chain(plan, cell_clock)
    hosted = {} if chain is None else chain.devices
    remote = None if chain is None else chain.scene
    # A scene that lives in a host is not here too.
    local = _scene(plan, cell_clock) if remote is None else None
    scene = local if remote is None else remote
    wanted = {name: device for name, device in {**plan.arms, **plan.sensors}.items() if name not in hosted}
    devices = build_devices(plan, wanted, cell_clock, local, hosted)
    arm_of = {name: role for role, name in plan.arm_roles.items()}
    arm_of |= {name: name for name in plan.arms if name not in arm_of}
    sensors = {role: _sensor(plan, name, devices, scene, arm_of) for role, name in plan.sensor_roles.items()}
    poses = {role: sensor.T_tcp_sensor for role, sensor in sensors.items()}
    arms = {role: cast(Arm, devices[name]) for name, role in arm_of.items()}
    planning_scene = build_planning_scene(plan, arms, {role: name for name, role in arm_of.items()})
    supervisor = Supervisor(build_interlocks(plan.cell.interlocks, poses, planning_scene), Latch())
    collection = _collection(plan)
    kept = 0 if collection is None else collection.kept

    def new_task() -> Task:
        return plan.task.build(plan.task_config, TaskContext(plan.cell.rate_hz, poses, kept))

    return Cell(
        plan=plan,
        clock=cell_clock,
        arms=arms,
        cameras={name: devices[name] for name in plan.sensors},
        sensors=sensors,
        supervisor=supervisor,
        task=new_task(),
        new_task=new_task,
        stop_categories={role: StopCategory(plan.cell.arms[name].stop_category) for name, role in arm_of.items()},
        holding=frozenset(
            arm_of[pair.follower] for pair in plan.cell.pairs if pair.on_stop == "hold" and pair.follower in arm_of
        ),
        watched_joints=frozenset(role for role, body in planning_scene.bodies.items() if body.link_count),
        scene=scene,
        collection=collection,
        watch=NullWatchdog() if chain is None else _process_watch(chain, arm_of),
    )


def build_devices(
    plan: CellPlan,
    wanted: Mapping[str, DevicePlan],
    clock: Clock | None = None,
    scene: Scene | None = None,
    present: Mapping[str, Device] | None = None,
) -> dict[str, Device]:
    """Make the ``wanted`` devices of ``plan``, DISCONNECTED, each after those that it depends on; with those present.

    Args:
        plan: a checked cell file.
        wanted: arms before the sensors that they carry.
        clock: in place of the one that the file asks for.
        scene: the simulated scene, if it is there already.
        present: devices that are there already.
    """
    clock = clock or _clock(plan)
    devices: dict[str, Device] = dict(present or {})
    if scene is None and wanted:
        scene = _scene(plan, clock)
    bases = {name: arm.T_world_base for name, arm in plan.cell.arms.items()}
    context = DriverContext(clock, devices, scene, plan.cell.seed, bases)
    for name, device in wanted.items():
        devices[name] = device.spec.build(name, device.config, context)
    return devices


def model_path(name: str) -> Path:
    """The file behind a cell file's ``model:``: a path, or ``builtin:NAME`` for one that ships with touchcell."""
    return MODELS / f"{name.removeprefix(BUILTIN)}.safetensors" if name.startswith(BUILTIN) else Path(name)


def _chain(plan: CellPlan, clock: Clock) -> Chain | None:
    if plan.cell.processes == "one":
        return None
    from touchcell.cell.runtime.process_watchdog import build_chain

    return build_chain(plan, clock)


def _process_watch(chain: Chain, role_of: Mapping[str, str]) -> Watchdog:
    from touchcell.cell.runtime.process_watchdog import ProcessWatch

    return ProcessWatch(chain, role_of)


def _clock(plan: CellPlan) -> Clock:
    return VirtualClock() if plan.cell.time == "simulated" else MonotonicClock()


def _scene(plan: CellPlan, clock: Clock) -> Scene | None:
    if plan.cell.scene is None:
        return None
    return scene_section().model_validate(plan.cell.scene).build(clock)


def _collection(plan: CellPlan) -> Collection | None:
    section = plan.cell.collect
    if section is None:
        return None
    # More samples of the same kind may be asked for later.
    about = {"cell": plan.cell.name, **plan.task_config.model_dump(exclude={"samples"})}
    return Collection(section.data, dict(section.shares.items()), about)


def _sensor(
    plan: CellPlan, name: str, devices: Mapping[str, Device], scene: SceneTruth | None, arm_of: Mapping[str, str]
) -> Sensor:
    section = plan.cell.sensors[name]
    T_tcp_sensor = section.T_tcp_sensor
    truth = _truth(name, devices.get(section.mounted_on or ""), scene, T_tcp_sensor)
    source: ContactSource
    if isinstance(section.estimator, NetworkEstimator):
        source = _pipeline(section, section.estimator, devices[name])
    elif isinstance(section.estimator, KnownSurface):
        T_base_f = se3.from_euler_mm_deg(np.array(section.estimator.surface_mm_deg))
        source = KnownSurfaceSource(cast(FrameSource, devices[name]), T_base_f)
    else:
        assert truth is not None
        source = truth
    return Sensor(
        source=source,
        arm_role=arm_of[section.mounted_on] if section.mounted_on else None,
        T_tcp_sensor=T_tcp_sensor,
        truth=truth,
        frames=plan.cell.recording.frames,
        watched=any(interlock.kind in ("frame_frozen", "exposure") for interlock in plan.cell.interlocks.values()),
    )


def _truth(name: str, mount: Device | None, scene: SceneTruth | None, T_tcp_sensor: Array) -> ContactSource | None:
    from touchcell.cell.runtime.ground_truth import LabelledContactSource, TrueContactSource
    from touchcell.drivers.replay.arm import ReplayArm

    if scene is not None:
        return TrueContactSource(scene, name)
    return LabelledContactSource(mount, T_tcp_sensor) if isinstance(mount, ReplayArm) else None


def _pipeline(section: SensorSection, estimator: NetworkEstimator, camera: Device) -> ContactPipeline:
    import cv2

    from touchcell.perception.runtime.contact_gate import ContactGate
    from touchcell.perception.runtime.estimators import load_estimator

    # A second thread gains nothing on images of this size (PERCEPTION part 5), and takes a core from other sensors.
    cv2.setNumThreads(1)
    calibration = None if estimator.calibration is None else Path(estimator.calibration)
    model = load_estimator(model_path(estimator.model), calibration)
    pose_filter = None if estimator.filter is None else build_filter(estimator.filter)
    contact_gate = None
    if (gate := estimator.gate) is not None:
        if model.reference is None:
            raise ConfigError(
                f"model {estimator.model} holds no image out of contact, which a contact gate compares with",
                key=f"sensors.{camera.name}.estimator.gate",
                value=estimator.model,
                hint="leave out `gate:`, so that every frame goes through the network",
            )
        contact_gate = ContactGate(model.reference, enter=gate.touch_percent / 100, leave=gate.release_percent / 100)
    return ContactPipeline(cast(FrameSource, camera), model, contact_gate=contact_gate, pose_filter=pose_filter)


def build_filter(settings: StillSurfaceSection | MovingSurfaceSection) -> ContactFilter:
    """The filter that a cell file's ``filter:`` describes."""
    from touchcell.perception.runtime.filter import PoseFilter, isotropic_noise

    drift = isotropic_noise(1e-3 * settings.drift_mm_per_sqrt_s, np.deg2rad(settings.drift_deg_per_sqrt_s))
    if isinstance(settings, StillSurfaceSection):
        return PoseFilter(drift)
    from touchcell.perception.runtime.moving_surface import MovingSurfaceFilter

    return MovingSurfaceFilter(
        drift,
        isotropic_noise(1e-3 * settings.accel_mm_s_per_sqrt_s, np.deg2rad(settings.accel_deg_s_per_sqrt_s)),
        isotropic_noise(1e-3 * settings.speed_mm_s, np.deg2rad(settings.speed_deg_s)),
    )


def _image_message(image: Any, kind: str, seq: int, t_ns: int) -> dict[str, Any]:
    import base64

    import cv2

    encoded = cv2.imencode(".jpg" if kind == "jpeg" else ".png", image)[1].tobytes()
    return {
        "timestamp": {"sec": t_ns // 10**9, "nsec": t_ns % 10**9},
        "frame_id": str(seq),
        "format": kind,
        "data": base64.b64encode(encoded).decode(),
    }
