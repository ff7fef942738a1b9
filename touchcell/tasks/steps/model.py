"""The steps of a task as validated data.

In a cell file each step is a mapping with one key, its kind:
``- move: {by_mm_deg: [0, 0, 30], until: {contact: true}}``.
In Python it is an object: ``Move(by_mm_deg=(0, 0, 30), until=Until(contact=True))``.
"""

from __future__ import annotations

import re
from typing import Annotated, Any, Literal, Self

from pydantic import (
    BeforeValidator,
    Discriminator,
    Field,
    GetJsonSchemaHandler,
    NonNegativeFloat,
    PositiveFloat,
    PositiveInt,
    model_validator,
)
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema

from touchcell.errors import suggest
from touchcell.tasks.contact_servo import ContactServoConfig, Six, SixGains
from touchcell.tasks.interface import CONTACT_DEPTH, DEPTH, DISTANCE, SPEED, TaskConfig

Three = tuple[float, float, float]
NAME = re.compile(r"[a-z][a-z0-9_]*\Z")
RESERVED = ("prepare", "withdraw", "done", "stopped", "failed", "tripped", "faulted")
"""States that every task of steps has besides its steps."""


class Until(TaskConfig):
    """Conditions that end a step; the first one to hold ends it.

    Attributes:
        contact: the sensor touches (true) or has come free (false).
        depth_mm: indentation reached, measured by the tactile sensor.
        force_n: force on the tool reached, as the arm measures it, less that at the beginning of the step.
        distance_mm: path of the sensor since the step began.
        time_s: time since the step began.
    """

    contact: bool | None = None
    depth_mm: Annotated[PositiveFloat | None, DEPTH] = None
    force_n: PositiveFloat | None = None
    distance_mm: PositiveFloat | None = None
    time_s: PositiveFloat | None = None

    @model_validator(mode="after")
    def _something(self) -> Self:
        if not self.model_fields_set or all(value is None for value in dict(self).values()):
            raise ValueError("names no condition; give contact, depth_mm, force_n, distance_mm or time_s")
        return self

    @property
    def needs_touch(self) -> bool:
        """True if a condition needs something to touch."""
        return self.contact is not None or self.depth_mm is not None or self.force_n is not None

    def touch(self) -> str:
        """Return a description of the touch that the conditions wait for."""
        wanted = []
        if self.contact is not None:
            wanted.append("contact")
        if self.depth_mm is not None:
            wanted.append(f"depth of {self.depth_mm:g} mm")
        if self.force_n is not None:
            wanted.append(f"force of {self.force_n:g} N")
        return " or ".join(wanted)


class _Step(TaskConfig):
    name: str | None = Field(
        default=None, description="name of the step's state; made from kind and number if left out"
    )

    @model_validator(mode="after")
    def _named(self) -> Self:
        if self.name is not None and (not NAME.match(self.name) or self.name in RESERVED):
            raise ValueError(f"name {self.name!r} is not a free lower-case word (reserved: {', '.join(RESERVED)})")
        return self


class Move(_Step):
    """Move the arm until it arrives or a condition holds.

    Exactly one of ``to_mm_deg``, ``by_mm_deg`` and ``velocity_mm_deg_s`` says where to. Arriving without a condition of
    ``until`` that needs touch is a failure: nothing was where the step expected it.

    Attributes:
        to_mm_deg: pose of the tool centre point in the base frame, x, y, z, alpha, beta, gamma (extrinsic xyz).
        by_mm_deg: displacement from where the step begins, 3 or 6 numbers, along the axes of ``frame``.
        velocity_mm_deg_s: velocity, 6 numbers, along the axes of ``frame``; needs ``until``.
        frame: base, tool, sensor, or contact (the surface frame when the step begins).
        speed_mm_s: largest speed.
        turn_deg_s: largest turning rate.
        until: conditions that end the step before it arrives.
        tolerance_mm, tolerance_deg: how near counts as arrived.
        timeout_s: longest time; the task fails after it.
    """

    kind: Literal["move"] = "move"
    to_mm_deg: Six | None = None
    by_mm_deg: Six | Three | None = None
    velocity_mm_deg_s: Six | None = None
    frame: Literal["base", "tool", "sensor", "contact"] = "sensor"
    speed_mm_s: Annotated[PositiveFloat, SPEED] = 20.0
    turn_deg_s: PositiveFloat = 20.0
    until: Until | None = None
    tolerance_mm: PositiveFloat = 0.2
    tolerance_deg: PositiveFloat = 0.5
    timeout_s: PositiveFloat = 30.0

    @model_validator(mode="after")
    def _one_way(self) -> Self:
        given = [self.to_mm_deg, self.by_mm_deg, self.velocity_mm_deg_s]
        if sum(each is not None for each in given) != 1:
            raise ValueError("needs exactly one of to_mm_deg, by_mm_deg and velocity_mm_deg_s")
        if self.velocity_mm_deg_s is not None and self.until is None:
            raise ValueError("velocity_mm_deg_s needs until: it has no goal to arrive at")
        if self.velocity_mm_deg_s is not None and self.frame == "contact":
            raise ValueError("velocity_mm_deg_s is along base, tool or sensor axes; use servo: to move in contact")
        if self.to_mm_deg is not None and "frame" in self.model_fields_set and self.frame != "base":
            raise ValueError("to_mm_deg is a pose in the base frame; use by_mm_deg for other frames")
        return self


class Servo(_Step):
    """Hold a contact by tactile servoing.

    Attributes:
        reference_mm_deg: contact to hold, x, y, z, alpha, beta, gamma of the sensor in the surface frame.
        depth_mm: indentation to hold, normal to the surface and without shear; instead of ``reference_mm_deg``.
        velocity_mm_deg_s: feedforward along the axes of the desired sensor frame, to move while holding.
        until: conditions that end the step.
        timeout_s: longest time; the task fails after it.
    """

    kind: Literal["servo"] = "servo"
    reference_mm_deg: Annotated[Six | None, CONTACT_DEPTH] = None
    depth_mm: Annotated[PositiveFloat | None, DEPTH] = None
    velocity_mm_deg_s: Six = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    until: Until
    timeout_s: PositiveFloat = 60.0

    @model_validator(mode="after")
    def _one_reference(self) -> Self:
        if (self.reference_mm_deg is None) == (self.depth_mm is None):
            raise ValueError("needs exactly one of depth_mm and reference_mm_deg")
        return self

    @property
    def reference(self) -> Six:
        """Contact to hold, mm and degrees."""
        return self.reference_mm_deg or (0.0, 0.0, self.depth_mm or 0.0, 0.0, 0.0, 0.0)


class Hold(_Step):
    """Hold the position.

    Attributes:
        time_s: duration.
    """

    kind: Literal["hold"] = "hold"
    time_s: PositiveFloat


class Retract(_Step):
    """Withdraw along the sensor's axis, also without fresh frames.

    Attributes:
        distance_mm: how far.
        speed_mm_s: speed.
        timeout_s: longest time; the task fails after it.
    """

    kind: Literal["retract"] = "retract"
    distance_mm: Annotated[PositiveFloat, DISTANCE]
    speed_mm_s: Annotated[PositiveFloat, SPEED] = 20.0
    timeout_s: PositiveFloat = 30.0


class Record(_Step):
    """Write the current tool pose and contact into the recording, as telemetry ``LABEL_x_mm`` and so on.

    Attributes:
        label: prefix of the numbers.
    """

    kind: Literal["record"] = "record"
    label: Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$")]


class Repeat(TaskConfig):
    """Do steps several times.

    Attributes:
        times: how often.
        steps: what.
    """

    kind: Literal["repeat"] = "repeat"
    times: PositiveInt
    steps: Annotated[list[Step], Field(min_length=1)]


KINDS = ("move", "servo", "hold", "retract", "record", "repeat")


def _by_kind(step: Any) -> Any:
    """Turn ``{move: {...}}`` into the fields of a ``Move``."""
    if not isinstance(step, dict) or "kind" in step:
        return step
    if len(step) != 1:
        raise ValueError(f"a step has one key, its kind ({', '.join(KINDS)}), found {len(step)}")
    kind, fields = next(iter(step.items()))
    if kind not in KINDS:
        raise ValueError(f"unknown step {kind!r} ({suggest(str(kind), KINDS, otherwise='steps')})")
    if not isinstance(fields, dict):
        raise ValueError(f"{kind} needs a mapping of its parameters, e.g. {{time_s: 1}}")
    # Strict validation takes a list for a tuple from JSON alone, which this is no longer.
    return {"kind": kind, **{key: tuple(value) if _numbers(value) else value for key, value in fields.items()}}


def _numbers(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(each, int | float) for each in value)


class _OneKey:
    """Describes a step to editors as ``_by_kind`` reads it: a mapping with one key."""

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        steps = dict(zip(KINDS, handler(schema)["oneOf"], strict=True))
        return {
            "type": "object",
            "properties": steps,
            "minProperties": 1,
            "maxProperties": 1,
            "additionalProperties": False,
        }


Step = Annotated[
    Annotated[Move | Servo | Hold | Retract | Record | Repeat, Discriminator("kind")],
    BeforeValidator(_by_kind),
    _OneKey(),
]
Repeat.model_rebuild()


class StepsConfig(ContactServoConfig):
    """A task written as steps. Gains and limits are those of every ``servo`` step.

    Attributes:
        steps: what to do, in order.
        withdraw_mm: how far to retract when the task is stopped, fails or runs out of time.
        withdraw_speed_mm_s: speed of that.
        prepare_timeout_s: longest wait for the first fresh frame and arm state.
        stale_timeout_s: the task trips when the arm has stood for lack of fresh data for this long.
    """

    steps: Annotated[list[Step], Field(min_length=1)]
    kp_per_s: SixGains = (0.0, 0.0, 8.0, 4.0, 4.0, 0.0)
    ki_per_s2: SixGains = (0.0, 0.0, 8.0, 4.0, 4.0, 0.0)
    withdraw_mm: NonNegativeFloat = 20.0
    withdraw_speed_mm_s: PositiveFloat = 20.0
    prepare_timeout_s: PositiveFloat = 5.0
    stale_timeout_s: PositiveFloat = 0.5

    @model_validator(mode="after")
    def _names_once(self) -> Self:
        names = [step.name for step in leaves(self.steps) if step.name]
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise ValueError(f"step name {twice[0]!r} is used twice")
        return self


Leaf = Move | Servo | Hold | Retract | Record


def leaves(steps: list[Step]) -> list[Leaf]:
    """The steps without their repetitions, in order."""
    found: list[Leaf] = []
    for step in steps:
        found += leaves(step.steps) if isinstance(step, Repeat) else [step]
    return found
