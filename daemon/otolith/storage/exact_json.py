"""Dataclasses of the core as JSON that is the same to the last bit, for evidence of events and for checkpoints.

Arrays keep their bits and their order in memory, on which the rounding of a product depends, and an instance that
occurs twice is one object afterwards, too. It can name nothing but the types that are expected, so that reading it runs
no code. A twin is not in it: its equations become code, so a reader takes them from the file, which is checked.
"""

import dataclasses
import json
import types
import typing
from collections.abc import Mapping
from enum import Enum
from functools import lru_cache
from typing import Any

import numpy as np
from pydantic import BaseModel

from otolith.acquisition.window import Window
from otolith.estimation.problem import Problem
from otolith.twin.components import augmented_model
from otolith.twin.definition import Definition

REFERENCE, AUGMENTED, BITS = "=", "augmented", "bits"  # keys of an object that occurred before, a twin, and an array


def encoded(value: Any) -> str:
    """Return a dataclass as JSON; raise TypeError if a part of it has a type that cannot be read again."""
    numbers: dict[int, int] = {}

    def encode(item: Any) -> Any:
        if isinstance(item, Definition):
            return {AUGMENTED: item.base is not None}
        if isinstance(item, np.ndarray):  # hexadecimal digits are quicker to write and to read than numbers
            order, bits = ("F", item.tobytes("F")) if item.flags.fnc else ("C", item.tobytes())
            return {"type": item.dtype.str, "shape": item.shape, "order": order, BITS: bits.hex()}
        if isinstance(item, BaseModel):
            return item.model_dump(mode="json")
        if isinstance(item, frozenset):
            return sorted(item)
        if id(item) in numbers:
            return {REFERENCE: numbers[id(item)]}
        numbers[id(item)] = len(numbers)
        return {name: getattr(item, name) for name in _fields(item.__class__)}

    return json.dumps(value, default=encode)


class Decoder:
    """The way back. It raises exceptions of any type for what :func:`encoded` has not written for this twin."""

    def __init__(self, twin: Definition) -> None:
        self._twin = twin
        self._objects: list[Any] = []

    def decode(self, kind: Any, content: Any) -> Any:
        """Return the value of type ``kind`` that was written as ``content``."""
        origin, arguments = typing.get_origin(kind), typing.get_args(kind)
        if origin in (typing.Union, types.UnionType):
            return self.decode(next((each for each in arguments if each is type(content)), arguments[0]), content)
        if origin is typing.Literal:
            return _required(content in arguments, content, kind)
        if origin is np.ndarray:
            return _array(content, typing.get_args(arguments[1])[0])
        if origin is not None:
            return self._items(origin, arguments, content)
        if issubclass(kind, Enum):
            return kind(content)
        if issubclass(kind, BaseModel):
            return kind.model_validate(content)
        if dataclasses.is_dataclass(kind):
            return self._instance(kind, _required(isinstance(content, dict), content, kind))
        return _required(type(content) in ((int, float) if kind is float else (kind,)), content, kind)

    def _items(self, origin: Any, kinds: tuple[Any, ...], content: Any) -> Any:
        if issubclass(origin, Mapping):
            return {key: self.decode(kinds[1], item) for key, item in content.items()}
        items = _required(isinstance(content, list), content, list)
        if origin is tuple and kinds[-1] is not Ellipsis:
            return tuple(self.decode(kind, item) for kind, item in zip(kinds, items, strict=True))
        return (frozenset if origin is frozenset else tuple)(self.decode(kinds[0], item) for item in items)

    def _instance(self, kind: Any, content: dict[str, Any]) -> Any:
        if kind is Definition:
            return augmented_model(self._twin) if content[AUGMENTED] else self._twin
        if REFERENCE in content:
            known = self._objects[_required(type(number := content[REFERENCE]) is int, number, int)]
            return _required(type(known) is kind, known, kind)
        fields, number = _fields(kind), len(self._objects)
        _required(content.keys() == fields.keys(), content, kind)
        self._objects.append(None)
        value = kind(**{name: self.decode(fields[name], item) for name, item in content.items()})
        self._objects[number] = value
        return _required(self._fits(value), value, "part of this twin")

    def _fits(self, value: Any) -> bool:
        """Return whether sizes are those of the twin: compiled code does not check them."""
        twin = self._twin
        if isinstance(value, Problem):
            noise = (value.stated_noise, value.steps, value.input_noise, value.process_noise)
            levels = (*twin.signals, *twin.states)
            sizes = zip(noise, (levels, twin.outputs, twin.inputs, twin.states), strict=True)
            return len(value.noise) == len(twin.outputs) and all(len(a) in (0, len(b)) for a, b in sizes)
        if isinstance(value, Window):
            shape, error = (value.grid.records, len(twin.signals)), value.bridge_error
            inputs = () if error is None else (error.noise_ratio, error.variance, error.held_variance)
            is_whole = all(array.shape == shape for array in (value.values, value.missing, *inputs))
            return is_whole and value.signals == twin.signals and value.grid.steps.shape == shape[:1] != (0,)
        return True


def _array(content: Any, kind: Any) -> np.ndarray:
    """Return an array that can be written to: kernels are compiled for such ones."""
    _required(content["type"] == np.dtype(kind).str, content["type"], kind)
    flat = np.frombuffer(bytes.fromhex(content[BITS]), kind)
    return flat.reshape(content["shape"], order=content["order"]).copy(order="K")


@lru_cache(maxsize=64)
def _fields(kind: Any) -> dict[str, Any]:
    """Return the types of the fields of a dataclass, without those that are derived."""
    hints = typing.get_type_hints(kind)
    return {each.name: hints[each.name] for each in dataclasses.fields(kind) if each.init}


def _required(condition: bool, value: Any, kind: Any) -> Any:
    if not condition:
        raise ValueError(f"{value!r:.40} is no {getattr(kind, '__name__', kind)}")
    return value
