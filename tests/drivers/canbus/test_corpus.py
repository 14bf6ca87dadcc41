"""Every database that the tests and the installed packages bring: no traceback, and the values of cantools.

``OTOLITH_DATABASES`` names a folder with more of them, such as the tests of cantools.
"""

import os
import random
import site
from collections.abc import Iterator
from pathlib import Path

import pytest
from cantools.database import Message
from cantools.database.can.database import Database

from otolith.cli.commissioning.probe_view import can_document
from otolith_drivers.base import Signal
from otolith_drivers.canbus.bus import BusOptions
from otolith_drivers.canbus.canopen import read_eds
from otolith_drivers.canbus.database import CanDatabase, load_database
from otolith_drivers.canbus.decoder import MessageReader, MessageRules
from otolith_drivers.canbus.options import CanSource, SignalRequest, request_from_databases
from otolith_drivers.canbus.probe import Picture
from otolith_drivers.errors import ConfigurationError
from tests.conftest import EXAMPLES
from tests.drivers.can_frames import decoder, frame
from tests.messages import assert_refuses
from tests.variants import often

SUFFIXES = {".dbc", ".kcd", ".sym", ".arxml", ".eds", ".dcf"}
FRAMES = 12  # of each message


def files() -> Iterator[Path]:
    """The databases and sheets, each once."""
    more = os.environ.get("OTOLITH_DATABASES")
    folders = [EXAMPLES, Path(__file__).parents[2], *map(Path, site.getsitepackages()), *([Path(more)] if more else [])]
    contents: set[bytes] = set()
    for path in sorted(path for folder in folders for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES):
        if path.is_file() and (content := path.read_bytes()) not in contents:
            contents.add(content)
            yield path


FILES = list(files())
DATABASES = [path for path in FILES if path.suffix.lower() not in {".eds", ".dcf"}]
SMALL = [path for path in DATABASES if path.stat().st_size < 100_000]


def requests_of(database: CanDatabase, message: Message) -> list[SignalRequest]:
    """Every signal that can be read without a range; an error of one is a line that names it."""
    requests = []
    for layout in message.signals:
        source = CanSource(signal=layout.name, message=message.name, unit="1", range=(-1e300, 1e300))
        try:
            requests.append(request_from_databases(Signal(layout.name, "1", source), [database]))
        except ConfigurationError as error:
            assert_refuses(error, "")
            assert "\n" not in str(error)  # noqa: PT017 - both outcomes are allowed
    return requests


def check_values(message: Message, reader: MessageReader, data: bytes, library: Database) -> int:
    """Compare a frame with what cantools decodes; return how many values were compared."""
    try:
        expected = library.get_message_by_name(message.name).decode(data, decode_choices=False)
    except Exception:  # noqa: BLE001 - cantools refuses frames with multiplexer values that it does not have
        return 0
    samples = reader.take(data, 0.0)
    assert isinstance(expected, dict)
    requested = {request.name for request in reader.requests}
    assert {sample.signal for sample in samples} == requested & set(expected)
    for sample in samples:
        number = expected[sample.signal]
        assert isinstance(number, int | float)
        if sample.value == sample.value and abs(number) < 1e299:
            assert sample.value == pytest.approx(number, rel=1e-12, abs=1e-12), sample.signal
    return len(samples)


@pytest.mark.parametrize("path", often(SMALL, DATABASES), ids=lambda path: path.name)
def test_values_of_every_database_are_those_of_cantools(path: Path) -> None:
    try:
        database = load_database(path)
    except ConfigurationError as error:
        assert_refuses(error, path)
        return
    generator, compared = random.Random(path.name), 0  # noqa: S311 - no secret
    for message in database.messages:
        requests = [] if message.is_container else requests_of(database, message)
        if requests:
            own = Database(messages=[message], strict=False)
            for _ in range(FRAMES):
                reader = MessageReader([message], requests, MessageRules())
                values = [generator.choice((generator.randrange(8), generator.randrange(256))) for _ in range(256)]
                compared += check_values(message, reader, bytes(values * 16)[: max(1, message.length)], own)
    assert compared > 50 or path.parent != EXAMPLES


@pytest.mark.parametrize("path", DATABASES, ids=lambda path: path.name)
def test_every_database_is_probed(path: Path) -> None:
    try:
        database = load_database(path)
    except ConfigurationError as error:
        assert_refuses(error, path)
        return
    picture, generator = Picture(Database(messages=list(database.messages), strict=False)), random.Random(path.name)  # noqa: S311
    for message in database.messages[:50]:
        for moment in range(10):
            data = generator.randbytes(min(64, message.length))
            picture.take(frame(message.frame_id, data, extended=message.is_extended_frame, fd=True), 0.01 * moment)
    assert can_document(picture, BusOptions(), path, 1.0)["lines"] or not database.messages


@pytest.mark.parametrize("path", [path for path in FILES if path not in DATABASES], ids=lambda path: path.name)
def test_every_sheet_is_read_or_refused(path: Path, tmp_path: Path) -> None:
    warnings: list[str] = []
    try:
        read_eds(path, 5, warnings)
        decoder(tmp_path, {"s": ("1", {"node": 5, "object": "0x6064", "unit": "1"})}, eds=str(path))
    except ConfigurationError as error:
        assert_refuses(error, "")
        assert "\n" not in str(error)  # noqa: PT017 - both outcomes are allowed


@pytest.mark.parametrize("path", often(SMALL, DATABASES), ids=lambda path: path.name)
def test_every_database_that_ends_too_early_is_read_or_refused(path: Path, tmp_path: Path) -> None:
    data, generator = path.read_bytes(), random.Random(path.name)  # noqa: S311
    for _ in range(4):
        cut = tmp_path / f"cut{path.suffix}"
        cut.write_bytes(data[: generator.randrange(len(data) + 1)])
        try:
            database = load_database(cut)
        except ConfigurationError as error:
            assert_refuses(error, cut)
            continue
        for message in database.messages:
            requests = [] if message.is_container else requests_of(database, message)
            if requests:
                MessageReader([message], requests, MessageRules()).take(bytes(max(1, message.length)), 0.0)
