"""Publish the ground truth of a simulated scene to the task's process: contacts and poses of objects."""

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
    """A scene in its host: publishes the truth of every mounted sensor and of every object.

    Args:
        scene: the scene.
        fds: descriptors of the blocks, by name of the sensor.
        objects_fd: descriptor of the objects' block.
    """

    def __init__(self, scene: Scene, fds: Mapping[str, int], objects_fd: int) -> None:
        self._scene = scene
        self._sensors = {name: RecordWriter(fd, TRUTH) for name, fd in fds.items()}
        self._objects = RecordWriter(objects_fd, OBJECTS)

    def update(self) -> None:
        """Publish the present truth."""
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
    """Proxy of a scene in another process: the newest truth published by its host.

    Args:
        objects: names of the free objects, in the order of the scene's section.

    Raises:
        ConfigError: more objects than a block holds.
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
        """Unmap the blocks."""
        self._exit.close()
        self._sensors = {}

    def contact(self, sensor: str, t_ns: int | None = None) -> Stamped[ContactState]:
        """Return the newest published contact, whatever ``t_ns`` is. Raises StaleData before the first."""
        record = self._sensors[sensor].read()
        if not record["t_ns"]:
            raise StaleData(sensor, float("inf"), 0.0, 0, hint="its host has published no contact yet")
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

    def edge(self, sensor: str, t_ns: int | None = None) -> Stamped[Array] | None:
        """Return None: edges are not published by other processes."""
        return None

    def objects(self) -> Stamped[Mapping[str, Array]]:
        """Return T_world_object (4, 4) of every free object, as last published."""
        record = self._objects.read()
        poses = [np.array(T) for T in record["T_world_object"][: len(self._names)]] if record["t_ns"] else []
        return Stamped(dict(zip(self._names, poses, strict=False)), int(record["t_ns"]), int(record["seq"]))
