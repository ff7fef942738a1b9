"""What a simulated scene in a host knows to be true, told to the task's process: contacts, and where objects are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import fields
from typing import TYPE_CHECKING

import numpy as np

from touchcell.drivers.core.errors import StaleData
from touchcell.drivers.core.samples import Stamped
from touchcell.drivers.core.scene import ContactState
from touchcell.drivers.hosting.layouts import MAX_OBJECTS, OBJECTS, TRUTH, RecordReader, RecordWriter
from touchcell.errors import ConfigError
from touchcell.geometry.types import Array

if TYPE_CHECKING:
    from touchcell.drivers.core.scene import Scene


class HostedScene:
    """The scene in its host: publishes the truth of every sensor that has been mounted, and of every object.

    Args:
        scene: which it is.
        fds: descriptors of the blocks, by name of the sensor.
        objects_fd: descriptor of the objects' block.
    """

    def __init__(self, scene: Scene, fds: Mapping[str, int], objects_fd: int) -> None:
        self._scene = scene
        self._sensors = {name: RecordWriter(fd, TRUTH) for name, fd in fds.items()}
        self._objects = RecordWriter(objects_fd, OBJECTS)

    def look(self) -> None:
        """Publish what is true now."""
        for name, record in self._sensors.items():
            if self._scene.has(name):
                contact = self._scene.contact(name)
                record.value["t_ns"], record.value["seq"] = contact.t_ns, contact.seq
                for field in fields(contact.value):
                    record.value[field.name] = getattr(contact.value, field.name)
                record.publish()
        objects = self._scene.objects()
        if objects.value:
            self._objects.value["t_ns"], self._objects.value["seq"] = objects.t_ns, objects.seq
            self._objects.value["T_world_object"][: len(objects.value)] = list(objects.value.values())
            self._objects.publish()


class RemoteScene:
    """A scene in another process, as far as it can be looked into: the newest truth that its host has told.

    Args:
        objects: names of the free objects, in the order of the scene's section.

    Raises:
        ConfigError: there are more objects than a block holds.
    """

    def __init__(self, objects: Sequence[str]) -> None:
        if len(objects) > MAX_OBJECTS:
            raise ConfigError(f"has {len(objects)} objects, more than {MAX_OBJECTS}", key="scene.objects")
        self._names = tuple(objects)
        self._sensors: dict[str, RecordReader] = {}
        self._exit = ExitStack()

    def attach(self, fds: Mapping[str, int], objects_fd: int) -> None:
        """Map the blocks."""
        self._sensors = {name: self._exit.enter_context(RecordReader(fd, TRUTH)) for name, fd in fds.items()}
        self._objects = self._exit.enter_context(RecordReader(objects_fd, OBJECTS))

    def detach(self) -> None:
        """Let go of them."""
        self._exit.close()
        self._sensors = {}

    def contact(self, sensor: str, t_ns: int | None = None) -> Stamped[ContactState]:
        """The newest contact that the host has told, whatever ``t_ns`` is. Raises StaleData before the first."""
        record = self._sensors[sensor].read()
        if not record["t_ns"]:
            raise StaleData(sensor, float("inf"), 0.0, 0, hint="its host has told no contact yet")
        shear_x_n, shear_y_n = record["shear_force_n"].tolist()
        state = ContactState(
            record["T_f_s"].copy(),
            record["T_world_f"].copy(),
            bool(record["in_contact"]),
            bool(record["slipping"]),
            float(record["normal_force_n"]),
            (shear_x_n, shear_y_n),
        )
        return Stamped(state, int(record["t_ns"]), int(record["seq"]))

    def objects(self) -> Stamped[Mapping[str, Array]]:
        """T_world_object (4, 4) of every free object, as the host has told last."""
        record = self._objects.read()
        poses = [np.array(T) for T in record["T_world_object"][: len(self._names)]] if record["t_ns"] else []
        return Stamped(dict(zip(self._names, poses, strict=False)), int(record["t_ns"]), int(record["seq"]))
