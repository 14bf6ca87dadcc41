"""The picture of the README: the live table of the demo after 84 s, drawn from the simulated motor.

python -m benchmarks.picture docs/pictures/demo.svg
"""

import io
import re
import sys
from dataclasses import replace
from pathlib import Path

from rich.console import Console

from benchmarks.motor import CONFIG, RECORDS, windows
from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import initial_state
from otolith.cli.operation.live_table import LiveTable
from otolith.machine import load_machine
from otolith_drivers.plant.scenario import load_scenario

SECONDS = 84.0
START = 1.7e9  # Unix seconds of the first record
COLUMNS = 124


def main(path: str) -> None:
    machine = load_machine(CONFIG / "dc-motor.toml")
    scenario = load_scenario(CONFIG / "scenarios" / "demo.toml")
    state = initial_state(machine.file.machine.name, machine.file.machine.site, machine.problem, machine.plan)
    table = LiveTable(lambda: "")
    for window in windows(scenario, round(SECONDS / (RECORDS * scenario.sample_period))):
        state, report = adapt(state, replace(window, start=START + window.start))
        table.add(report.document.to_json())
    console = Console(record=True, width=COLUMNS, file=io.StringIO(), force_terminal=True, color_system="truecolor")
    console.print(table)
    text = console.export_svg(title="otolith watch")
    text = re.sub(r"@font-face \{.*?\}\s*", "", text, flags=re.DOTALL)  # the browser's own font, none from the network
    Path(path).write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1])
