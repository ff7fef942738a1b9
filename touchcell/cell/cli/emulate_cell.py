"""``touchcell emulate cell FILE``: every device of a cell file as an emulator, around one simulated scene.

    touchcell emulate cell configs/dual_push_emulated.yaml

prints the command that runs the cell on them. Arms are processes of their own, as they keep time to a millisecond; the
scene and the cameras are in this one. Where an emulated arm is, there its tip touches the scene of the file's
``emulated_scene:``, and the camera that it carries shows that tip. The cell sees none of this but frames and poses.
"""

from __future__ import annotations

import argparse
import re
import shlex
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np

from touchcell.cell.config.cell_plan import CellPlan
from touchcell.cell.config.default_scene import start_of
from touchcell.cell.config.find import find_cell
from touchcell.cell.config.schema import plan_cell
from touchcell.drivers.core.behaviour import CameraBehaviour
from touchcell.drivers.core.paced_clock import emulated_clock
from touchcell.drivers.v4l2.emulator.server import V4l2Emulator
from touchcell.drivers.v4l2.shim import environment
from touchcell.errors import ConfigError
from touchcell.geometry.types import Array, ImageArray
from touchcell.simulation.render import FrameRenderer
from touchcell.simulation.scene import Scene, SceneConfig
from touchcell.simulation.tip import Tip
from touchcell.testing.emulation.base import Emulator
from touchcell.testing.emulation.in_cell import EMULATED, TcpOfJoints
from touchcell.testing.emulation.process import EmulatorProcess
from touchcell.testing.emulation.ticker import Ticker

_MOVED_RAD: Final = 2e-5
_CAMERA = re.compile(r"/dev/(?:video|v4l/by-id/usb-TacTip_)(\d+)(?:-video-index0)?")


class EmulatedArm:
    """An emulated arm that carries a sensor through a scene; once it is gone, it is where it was last.

    Args:
        process: its emulator, running.
        T_base_tcp: returns the pose (4, 4) of its tool for its joint angles (n,) rad.
        T_world_base: (4, 4) where its base stands.

    Attributes:
        moved_ns: scene's time at which it was last seen to have moved; 0 before.
    """

    def __init__(
        self,
        process: EmulatorProcess,
        T_base_tcp: TcpOfJoints,
        T_world_base: Array,
    ) -> None:
        self._process = process
        self._T_base_tcp = T_base_tcp
        self._T_world_base = T_world_base
        self._q = process.joints()
        self.moved_ns = 0

    def watch(self, t_ns: int) -> None:
        """Note whether it has moved since the last call; ``t_ns`` is the scene's time."""
        q = self._process.joints()
        if np.abs(q - self._q).max() > _MOVED_RAD:
            self._q, self.moved_ns = q, t_ns

    def T_world_tcp(self) -> Array:  # noqa: N802  the field's own name
        """(4, 4) where its tool truly is."""
        T: Array = self._T_world_base @ self._T_base_tcp(self._process.joints())
        return T


class CellEmulator(Emulator):
    """All devices that the task of a cell needs, and what they touch.

    Args:
        plan: the cell.
        folder: where the cameras' sockets live.
        command: runs the cell on it; printed once everything has started.

    Raises:
        ConfigError: the cell has no ``emulated_scene:``, or a device that this cannot emulate.
    """

    def __init__(self, plan: CellPlan, folder: Path, command: str = "") -> None:
        super().__init__()
        self._command = command
        if plan.cell.emulated_scene is None:
            raise ConfigError("there is nothing to touch", key="emulated_scene", hint="describe it as a `scene:`")
        self._scene_config = SceneConfig.model_validate(plan.cell.emulated_scene)
        self._plan = plan
        self._arm_processes = {name: _arm_process(plan, name) for name in plan.arms}
        self._arms: dict[str, EmulatedArm] = {}
        self._cameras = {name: self._camera(name, folder) for name in plan.sensors}
        self._scene: Scene | None = None
        self._waits_for_an_arm = bool(plan.arms) and self._scene_config.physics == "kinematic"
        self._ticker: Ticker | None = None
        self._tip = Tip()
        self._renderers = {
            name: FrameRenderer(self._tip.parameters.disc_radius_px, seed=(plan.cell.seed, number))
            for number, name in enumerate(plan.sensors)
        }

    async def start(self) -> None:
        for process in self._arm_processes.values():
            process.start()
        self._arms = {name: self._arm(name) for name in self._arm_processes}
        scene = self._scene = self._scene_config.build(emulated_clock())
        for name in self._cameras:
            scene.mount(name, self._sensor_pose(name))
        self._ticker = Ticker(scene.timeline.step_ns, lambda _: self._advance(scene))
        for camera in self._cameras.values():
            await camera.start()
        if self._command:
            print(self._command, file=sys.stderr)

    async def stop(self) -> None:
        for camera in self._cameras.values():
            await camera.stop()
        if self._ticker is not None:
            self._ticker.close()
        for process in self._arm_processes.values():
            process.stop()

    def begin(self, fault: str, value: Any = True) -> None:
        """Inject the fault ``DEVICE.FAULT`` of one of the devices. Raises ConfigError for an unknown one."""
        device, _, name = fault.partition(".")
        if device in self._arm_processes:
            self._arm_processes[device].fault(name, value)
        elif device in self._cameras:
            self._cameras[device].begin(name, value)
        else:
            super().begin(fault, value)

    def end(self, fault: str) -> None:
        """End the fault ``DEVICE.FAULT`` of one of the devices."""
        device, _, name = fault.partition(".")
        if device in self._arm_processes:
            self._arm_processes[device].clear(name)
        elif device in self._cameras:
            self._cameras[device].end(name)
        else:
            super().end(fault)

    def state(self) -> dict[str, Any]:
        """What is true: where objects and sensors are, and what these touch; cameras as their own emulators report."""
        scene = self._scene
        if scene is None:
            return {}
        objects = scene.objects()
        felt = {name: scene.contact(name).value for name in self._cameras}
        return {
            "t_ns": objects.t_ns,
            "objects": {name: T.tolist() for name, T in objects.value.items()},
            "moved_ns": {name: arm.moved_ns for name, arm in self._arms.items()},
            "sensors": {name: self._sensor_pose(name)().tolist() for name in self._cameras},
            "contacts": {name: state.T_f_s.tolist() if state.in_contact else None for name, state in felt.items()},
            "cameras": {name: camera.state() for name, camera in self._cameras.items()},
        }

    def _advance(self, scene: Scene) -> None:
        """Take the steps that are due. Surfaces begin to move when the first arm does: with the cell, not with us."""
        t_ns = scene.timeline.advance()
        for arm in self._arms.values():
            arm.watch(t_ns)
        if self._waits_for_an_arm:
            scene.begin_now()
            self._waits_for_an_arm = not any(arm.moved_ns for arm in self._arms.values())

    def _arm(self, name: str) -> EmulatedArm:
        device = self._plan.arms[name]
        where = EMULATED.load(device.spec.name).T_base_tcp
        assert where is not None
        process = self._arm_processes[name]
        return EmulatedArm(process, where(device.config, process.state()), self._plan.cell.arms[name].T_world_base)

    def _camera(self, name: str, folder: Path) -> V4l2Emulator:
        device = self._plan.sensors[name]
        if device.spec.name != "v4l2":
            raise _not_emulated("sensors", name, device.spec.name, "v4l2")
        if self._plan.cell.sensors[name].mounted_on is None and self._plan.arms:
            raise ConfigError("nothing carries it", key=f"sensors.{name}.mounted_on", hint="name one of the arms")
        node = str(getattr(device.config, "device", ""))
        found = _CAMERA.fullmatch(node)
        if found is None:
            raise ConfigError(
                "no emulated camera is called so",
                key=f"sensors.{name}.device",
                value=node,
                hint="/dev/v4l/by-id/usb-TacTip_0000-video-index0, or another number",
            )
        behaviour = device.spec.behaviour(device.config) if device.spec.behaviour is not None else None
        latency_s = behaviour.latency_s if isinstance(behaviour, CameraBehaviour) else 0.0
        return V4l2Emulator(folder, int(found[1]), show=lambda number: self._picture(name, number), latency_s=latency_s)

    def _sensor_pose(self, name: str) -> Callable[[], Array]:
        section = self._plan.cell.sensors[name]
        T_tcp_s = section.T_tcp_sensor
        if section.mounted_on is None:
            return lambda: T_tcp_s
        arm = self._arms[section.mounted_on]
        return lambda: arm.T_world_tcp() @ T_tcp_s

    def _picture(self, name: str, number: int) -> ImageArray:
        scene = self._scene
        assert scene is not None
        relief = scene.relief(name, self._tip.relief.directions) if scene.feels_shape else None
        pixels = self._tip.pixels(scene.contact(name).value.T_f_s, relief)
        return self._renderers[name].raw(pixels, number)


def _arm_process(plan: CellPlan, name: str) -> EmulatorProcess:
    """Return the emulator of an arm, not started yet, at the start pose of the cell file."""
    device, given = plan.arms[name], plan.cell.arms[name].start_pose_mm_deg
    arms = [each for each in EMULATED.names() if EMULATED.load(each).start is not None]
    start = EMULATED.load(device.spec.name).start if device.spec.name in arms else None
    if start is None:
        raise _not_emulated("arms", name, device.spec.name, ", ".join(arms))
    q = None if given is None else start_of(plan, name, given).q
    return start(device.config, None if q is None else np.degrees(q).tolist())


def _not_emulated(kind: str, name: str, driver: str, known: str) -> ConfigError:
    return ConfigError(
        "there is no emulator for it here", key=f"{kind}.{name}.driver", value=driver, hint=f"known: {known}"
    )


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare its command line."""
    parser.add_argument("cell", type=Path, help="cell file with an `emulated_scene:`")
    folder = Path(tempfile.gettempdir()) / "touchcell-cameras"
    parser.add_argument("--folder", type=Path, default=folder, help="folder for the cameras' sockets")


def build(arguments: argparse.Namespace) -> CellEmulator:
    """Make the emulator, not yet started; once started it prints how to run the cell on it."""
    variables = [f"{key}={value}" for key, value in environment(arguments.folder).items()]
    command = shlex.join(["env", *variables, "touchcell", "run", str(arguments.cell)])
    return CellEmulator(plan_cell(find_cell(arguments.cell)), arguments.folder, command)
