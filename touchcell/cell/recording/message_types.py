"""Protobuf types of recorded messages, made from a declaration of their fields: schema, encoder and decoder in one.

A type is declared by its fields (``messages.py`` has those of a cell). Where a plug-in records fields that none has
declared, the type grows with the first message that has them, under the same name.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from typing import Any, Final, NamedTuple

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, json_format, message_factory, struct_pb2
from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import DecodeError, Message

PACKAGE: Final = "touchcell"
"""Package of all types that are declared here; others in a recording are those of viewers."""

_VIEWERS: Final = "foxglove."
_STAMP: Final = "timestamp"
_VALUE: Final = ".google.protobuf.Value"
_INT64: Final = 1 << 63
_Field = descriptor_pb2.FieldDescriptorProto


class Kind(Enum):
    """Kind of a field: a number, a text, a list of either, or anything that JSON can express."""

    REAL = _Field.TYPE_DOUBLE, False
    INTEGER = _Field.TYPE_INT64, False
    FLAG = _Field.TYPE_BOOL, False
    TEXT = _Field.TYPE_STRING, False
    BYTES = _Field.TYPE_BYTES, False
    REALS = _Field.TYPE_DOUBLE, True
    TEXTS = _Field.TYPE_STRING, True
    ANY = _Field.TYPE_MESSAGE, False


class UnreadableType(ValueError):
    """A schema that is none."""


class Encoded(NamedTuple):
    """A message as bytes, and the type that reads them."""

    type: MessageType
    data: bytes

    def decode(self) -> dict[str, Any]:
        """Return the message's fields."""
        return self.type.decode(self.data)


@dataclass(frozen=True)
class MessageType:
    """A protobuf type.

    Attributes:
        name: without the package.
        fields: kind of each field, in the order of their numbers.
    """

    name: str
    fields: Mapping[str, Kind]

    @property
    def full_name(self) -> str:
        """Name with the package."""
        return f"{PACKAGE}.{self.name}"

    @cached_property
    def schema(self) -> bytes:
        """Serialized FileDescriptorSet, as MCAP stores it."""
        file = descriptor_pb2.FileDescriptorProto(name=f"{PACKAGE}/{self.name}.proto", package=PACKAGE, syntax="proto3")
        message = file.message_type.add(name=self.name)
        taken: set[str] = set()
        for number, (key, kind) in enumerate(self.fields.items(), start=1):
            name = _identifier(key, taken)
            type_, repeated = kind.value
            field = message.field.add(
                name=name,
                json_name=key,
                number=number,
                type=type_,
                label=_Field.LABEL_REPEATED if repeated else _Field.LABEL_OPTIONAL,
            )
            if kind is Kind.ANY:
                field.type_name = _VALUE
            elif not repeated:
                # An explicit presence: a field that a message does not have is not read as zero.
                field.proto3_optional = True
                field.oneof_index = len(message.oneof_decl)
                message.oneof_decl.add(name=f"_{name}")
        files = [file]
        if Kind.ANY in self.fields.values():
            value = descriptor_pb2.FileDescriptorProto()
            struct_pb2.DESCRIPTOR.CopyToProto(value)
            file.dependency.append(value.name)
            files.insert(0, value)
        schema: bytes = descriptor_pb2.FileDescriptorSet(file=files).SerializeToString(deterministic=True)
        return schema

    @cached_property
    def _class(self) -> type[Message]:
        return message_class(self.full_name, self.schema)

    @cached_property
    def _renamed(self) -> dict[str, str]:
        """Names of fields by key, of those that are no identifiers."""
        fields = self._class.DESCRIPTOR.fields
        return {field.json_name: field.name for field in fields if field.json_name != field.name}

    @cached_property
    def decode(self) -> Callable[[bytes], dict[str, Any]]:
        """Function from bytes to fields: see ``decoder``."""
        return decoder(self._class)

    def encode(self, data: Mapping[str, Any]) -> bytes:
        """Return the message as bytes; fields that are None are left out.

        Raises:
            ValueError, TypeError: it has a field that the type has not, or one of another kind.
        """
        return self._class(**data).SerializeToString()  # type: ignore[no-any-return]

    def encode_plain(self, data: Mapping[str, Any]) -> bytes:
        """The same of data that ``plain`` has made, with keys that are no identifiers and fields of any kind."""
        message = self._class()
        values: dict[str, Any] = {}
        for key, value in data.items():
            kind = self.fields.get(key)
            # A value of no kind, as an empty list of a type that grows.
            if value is None or kind is None:
                continue
            name = self._renamed.get(key, key)
            if kind is Kind.ANY:
                json_format.ParseDict(value, getattr(message, name))
            elif isinstance(value, list):
                values[name] = [math.nan if item is None else item for item in value]
            else:
                values[name] = value
        message.MergeFrom(self._class(**values))
        encoded: bytes = message.SerializeToString()
        return encoded

    def fitting(self, data: Mapping[str, Any]) -> MessageType:
        """Return the type with room for ``data``, which ``plain`` has made; fields keep their numbers."""
        fields = dict(self.fields)
        for key, value in data.items():
            kind = _kind(value)
            if kind is None:
                continue
            present = fields.get(key)
            if present is None:
                fields[key] = kind
            elif present is not kind and not (present is Kind.REAL and kind is Kind.INTEGER):
                fields[key] = Kind.REAL if {present, kind} == {Kind.REAL, Kind.INTEGER} else Kind.ANY
        return self if fields == self.fields else MessageType(self.name, fields)


class Encoder:
    """Encodes messages by topic, each by the type of its topic, which grows with what is recorded.

    Args:
        declared: returns the type of a topic.
    """

    def __init__(self, declared: Callable[[str], MessageType]) -> None:
        self._declared = declared
        self._types: dict[str, MessageType] = {}

    def encode(self, topic: str, data: Mapping[str, Any]) -> Encoded:
        """Return a message as bytes; numpy values become numbers and lists.

        Raises:
            TypeError: a value cannot be recorded.
        """
        known = self._types.get(topic)
        if known is None:
            known = self._types[topic] = self._declared(topic)
        try:
            return Encoded(known, known.encode(data))
        except (ValueError, TypeError):
            simple = plain(data)
        grown = self._types[topic] = known.fitting(simple)
        return Encoded(grown, grown.encode_plain(simple))


def plain(data: Mapping[str, Any]) -> dict[str, Any]:
    """Return a message as numbers, texts, lists and mappings; in what is nested, None stands for what is not finite.

    Raises:
        TypeError: a value is none of these.
    """
    return {str(key): _plain(value) for key, value in data.items()}


def decoder(kind: type[Message]) -> Callable[[bytes], dict[str, Any]]:
    """Return a function that reads messages of a class as JSON would hold them: None for what is not finite.

    Lists are there even if they are empty; other fields only where the message has them. The stamp that viewers' types
    carry is left out, since the record has it as well.
    """
    lists = [field.json_name for field in kind.DESCRIPTOR.fields if field.is_repeated]

    def decode(data: bytes) -> dict[str, Any]:
        message = kind.FromString(data)
        found: dict[str, Any] = {name: [] for name in lists}
        for field, value in message.ListFields():
            if field.full_name.startswith(_VIEWERS) and field.name == _STAMP:
                continue
            found[field.json_name] = _read(field, value)
        return found

    return decode


def message_class(full_name: str, schema: bytes) -> type[Message]:
    """Return the class of a type in a serialized FileDescriptorSet. Raises UnreadableType."""
    pool = descriptor_pool.DescriptorPool()
    try:
        for file in descriptor_pb2.FileDescriptorSet.FromString(schema).file:
            pool.Add(file)
        found: type[Message] = message_factory.GetMessageClass(pool.FindMessageTypeByName(full_name))
    except (DecodeError, TypeError, KeyError, ValueError, RecursionError) as error:
        raise UnreadableType(f"the schema of {full_name} is damaged: {error}") from None
    return found


def camel_case(topic: str) -> str:
    """Return a type's name for a topic without a declaration: ``/devices/ft/reading`` is DevicesFtReading."""
    parts = [part for part in re.split(r"\W+|_", topic) if part]
    name = "".join(part[0].upper() + part[1:] for part in parts)
    return name if name[:1].isalpha() and name.isascii() else f"Topic{name.encode().hex()}"


def _read(field: FieldDescriptor, value: Any) -> Any:
    if field.is_repeated:
        if field.type == FieldDescriptor.TYPE_DOUBLE:
            return [item if math.isfinite(item) else None for item in value]
        if field.type == FieldDescriptor.TYPE_MESSAGE:
            return [json_format.MessageToDict(item) for item in value]
        return list(value)
    if field.type == FieldDescriptor.TYPE_DOUBLE:
        return value if math.isfinite(value) else None
    if field.type == FieldDescriptor.TYPE_MESSAGE:
        return _integers(json_format.MessageToDict(value))
    return value


def _integers(value: Any) -> Any:
    """Return what ``google.protobuf.Value`` has read, with whole numbers as integers again."""
    if isinstance(value, float):
        return int(value) if value.is_integer() else value
    if isinstance(value, dict):
        return {key: _integers(item) for key, item in value.items()}
    return [_integers(item) for item in value] if isinstance(value, list) else value


def _plain(value: Any, *, nested: bool = False) -> Any:
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, float):
        return None if nested and not math.isfinite(value) else value
    if value is None or isinstance(value, bool | str | bytes | int):
        return value
    if isinstance(value, Mapping):
        return {str(key): _plain(item, nested=True) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item, nested=True) for item in value]
    raise TypeError(f"{type(value).__name__} cannot be recorded")


def _kind(value: Any) -> Kind | None:
    """Return the kind of a plain value; None for one that says nothing about it."""
    if value is None or value == []:
        return None
    if isinstance(value, list):
        kinds = {Kind.REAL if item is None else _kind(item) for item in value}
        if kinds <= {Kind.REAL, Kind.INTEGER}:
            return Kind.REALS
        return Kind.TEXTS if kinds == {Kind.TEXT} else Kind.ANY
    if isinstance(value, bool):
        return Kind.FLAG
    if isinstance(value, int):
        return Kind.INTEGER if -_INT64 <= value < _INT64 else Kind.REAL
    for type_, kind in ((float, Kind.REAL), (str, Kind.TEXT), (bytes, Kind.BYTES)):
        if isinstance(value, type_):
            return kind
    return Kind.ANY


def _identifier(key: str, taken: set[str]) -> str:
    name = re.sub(r"[^A-Za-z0-9_]", "_", key)
    if not name[:1].isalpha():
        name = f"f_{name}"
    while name in taken:
        name += "_"
    taken.add(name)
    return name
