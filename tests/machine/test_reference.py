"""docs/reference/machine-file.md lists every key of a machine file, with its default."""

import re
import tomllib
from pathlib import Path

import pytest
from pydantic import BaseModel, TypeAdapter

from otolith import machine_file
from otolith.fmu_twin import VariableTable
from otolith.health.diagnosis import OwnRule
from otolith.outlet_tables import PrometheusOutlet
from otolith.twin.language import OperationTable
from otolith_drivers.canbus import driver as can
from otolith_drivers.canbus.options import MessageTable, PdoTable
from otolith_drivers.modbus import driver as modbus
from otolith_drivers.plant import realtime as plant
from otolith_drivers.replay import driver as replay
from otolith_drivers.replay.table import reader as tables

PAGE = (Path(__file__).parents[2] / "docs" / "reference" / "machine-file.md").read_text(encoding="utf-8")
SIGNAL = "key of a signal"

# Heading of the section, first cell of the table's header, and the model of the table.
TABLES: list[tuple[str, str, type[BaseModel]]] = [
    ("[machine]", "key", machine_file.MachineTable),
    ("[twin]", "key", machine_file.TwinTable),
    ("[twin]", "key of a variable", VariableTable),
    ("[parameters]", "key", machine_file.ParameterTable),
    ("[components]", "key", machine_file.LimitsTable),
    ("[[rule]]", "key", OwnRule),
    ("[operation]", "key", OperationTable),
    ("unknown", "key of an unmeasured input", machine_file.UnmeasuredTable),
    ("[window]", "key", machine_file.WindowTable),
    ("[estimation]", "key", machine_file.EstimationTable),
    ("[discovery]", "key", machine_file.DiscoveryTable),
    ("[swarm]", "key", machine_file.SwarmTable),
    ("[zenoh]", "key", machine_file.ZenohTable),
    ("[zenoh]", "key of `[zenoh.tls]`", machine_file.TlsTable),
    ("[zenoh]", "key of `[zenoh.access]`", machine_file.AccessTable),
    ("[recording]", "key", machine_file.RecordingTable),
    ("[history]", "key", machine_file.HistoryTable),
    ("[outlets]", "key of `[outlets.prometheus]`", PrometheusOutlet),
    ('type = "can"', "key", can.Options),
    ('type = "can"', "key of `[[driver.pdo]]`", PdoTable),
    ('type = "can"', "key of `[driver.messages.Name]`", MessageTable),
    ('type = "can"', SIGNAL, can.Source),
    ('type = "modbus"', "key", modbus.Options),
    ('type = "modbus"', SIGNAL, modbus.Source),
    ('type = "replay"', "key", replay.Options),
    ('type = "replay"', SIGNAL, tables.Source),
    ('type = "plant"', "key", plant.Options),
    ('type = "plant"', SIGNAL, plant.Source),
]


def rows_of(section: str, first_cell: str) -> dict[str, dict[str, str]]:
    """Cells of each row by column, of one table of the page."""
    (text,) = [text for text in re.split(r"^##+ ", PAGE, flags=re.MULTILINE) if text.startswith(f"`{section}`")]
    block = re.search(rf"^\| {re.escape(first_cell)} \|.*\n\|[-|]+\n((?:\|.*\n)+)", text, re.MULTILINE)
    assert block is not None
    columns = [cell.strip() for cell in block[0].splitlines()[0].strip("|").split("|")]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in block[1].splitlines()]
    return {cells[0].strip("`"): dict(zip(columns, cells, strict=True)) for cells in rows}


@pytest.mark.parametrize(("section", "first_cell", "model"), TABLES)
def test_every_key_is_listed_with_its_default(section: str, first_cell: str, model: type[BaseModel]) -> None:
    rows = rows_of(section, first_cell)
    fields = {field.alias or name: field for name, field in model.model_fields.items()}
    assert set(rows) == set(fields)
    for key, field in fields.items():
        cell = rows[key]["default"].strip("`")
        assert (cell == "required") == field.is_required(), key
        if not field.is_required() and isinstance(field.default, int | float | str):
            written = tomllib.loads(f"value = {cell}")["value"]
            assert TypeAdapter(field.rebuild_annotation()).validate_python(written) == field.default, key


def test_every_table_is_listed() -> None:
    sections = set(re.findall(r"`\[{1,2}([a-z_]+)\]{1,2}`", "\n".join(re.findall(r"^## .*", PAGE, re.MULTILINE))))
    assert sections == set(machine_file.MachineFile.model_fields)
