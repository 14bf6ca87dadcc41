"""Shared by the tests of the CAN decoder: a decoder of a few signals, and frames for it."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import can

from otolith_drivers.base import Sample, Setup, Signal
from otolith_drivers.canbus.decoder import FrameDecoder, decoder_of
from otolith_drivers.canbus.options import CanSource, FrameOptions

Requests = Mapping[str, tuple[str, dict[str, Any]]]
"""Name of each signal, its unit, and its source as in a machine file."""


def signals(requested: Requests) -> tuple[Signal, ...]:
    return tuple(Signal(name, unit, CanSource.model_validate(source)) for name, (unit, source) in requested.items())


def decoder(folder: Path, requested: Requests, text: str = "", suffix: str = "dbc", **options: Any) -> FrameDecoder:
    """A decoder of the ``requested`` signals, with the database ``text`` if there is one."""
    if text:
        (folder / f"drive.{suffix}").write_text(text, encoding="utf-8")
        options["dbc"] = f"drive.{suffix}"
    return decoder_of(FrameOptions.model_validate(options), Setup(signals(requested), folder, 0.01))


def frame(identifier: int, data: bytes, *, extended: bool = False, fd: bool = False) -> can.Message:
    return can.Message(arbitration_id=identifier, data=data, is_extended_id=extended, is_fd=fd)


def values(samples: list[Sample]) -> dict[str, float]:
    return {sample.signal: sample.value for sample in samples}


def dbc(*messages: str, after: str = "") -> str:
    """A database of ``messages``, each as ``BO_`` and ``SG_`` lines."""
    return "\n\n".join(['VERSION ""', "NS_ :", "BS_:", "BU_: Drive Monitor", *messages, after, ""])
