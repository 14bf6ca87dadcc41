"""The example driver keeps the contract, and its entry point makes it a driver of machine files."""

import os
import re
import subprocess
import sys
from importlib import import_module
from pathlib import Path

from otolith_drivers.conformance import CONTRACT
from tests.conftest import EXAMPLES

FOLDER = Path(__file__).parents[2] / "docs" / "example-driver"
MODULE = "otolith_tcp_json.py"


def run(*command: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *command], capture_output=True, text=True, timeout=600, check=False,
        cwd=FOLDER, env={**os.environ, **environment},
    )  # fmt: skip


def test_the_page_names_where_its_classes_are() -> None:
    page = (FOLDER.parent / "your-own-driver.md").read_text(encoding="utf-8")
    places = re.findall(r"`(\w+)` of\s+`(otolith_drivers[.\w]*)`", page)
    assert [name for name, _ in places] == ["ThreadedDriver", "Conversion"]
    for name, module in places:
        assert hasattr(import_module(module), name)


def test_example_driver_keeps_the_contract() -> None:
    done = run("-m", "pytest", "-q", "-p", "no:cacheprovider", str(FOLDER), PYTHONDONTWRITEBYTECODE="1")
    assert done.returncode == 0, done.stdout
    assert f"{len(CONTRACT) + 2} passed" in done.stdout  # and those of reconnection and bad lines


def test_entry_point_registers_the_example_driver(tmp_path: Path) -> None:
    """The module and its metadata are in a folder of packages, as pip installs them."""
    (tmp_path / MODULE).write_bytes((FOLDER / MODULE).read_bytes())
    metadata = tmp_path / "otolith_tcp_json-0.1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: otolith-tcp-json\nVersion: 0.1.0\n")
    (metadata / "entry_points.txt").write_text("[otolith.drivers]\ntcp_json = otolith_tcp_json\n")
    assert 'tcp_json = "otolith_tcp_json"' in (FOLDER / "pyproject.toml").read_text(encoding="utf-8")

    text = (EXAMPLES / "dc-motor.toml").read_text(encoding="utf-8")
    text = text.replace(
        'type = "can"\ndbc = "dc-motor.dbc"\n', 'type = "tcp_json"\nhost = "192.168.0.10"\nport = 5005\n'
    )
    for name, unit in (
        ("ArmatureVoltage", "V"),
        ("LoadTorque", "mN*m"),
        ("ArmatureCurrent", "A"),
        ("RotorSpeed", "rpm"),
    ):
        text = text.replace(f'{{ signal = "{name}" }}', f'{{ key = "{name}", unit = "{unit}" }}')
    machine = tmp_path / "machine.toml"
    machine.write_text(text, encoding="utf-8")
    done = run("-m", "otolith", "check", "--no-device", str(machine), PYTHONPATH=str(tmp_path))
    assert done.returncode == 0, done.stderr
    assert "omega from RotorSpeed" in done.stdout
    machine.write_text(text.replace("port = 5005", "prt = 5005"), encoding="utf-8")
    refused = run("-m", "otolith", "check", "--no-device", str(machine), PYTHONPATH=str(tmp_path))
    assert refused.returncode == 2
    assert "unknown key 'prt': did you mean 'port'?" in refused.stderr
