"""The rules of the architecture: imports, sizes and names. Each rule fails when it is broken."""

import re
import shutil
import subprocess
import sys
import tomllib
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
LINTER = Path(sys.executable).with_name("lint-imports")
SOURCES = sorted(path for root in ("daemon", "drivers") for path in (ROOT / root).rglob("*.py"))
MAX_FILE_LINES = 600
MAX_MODULES_IN_A_FOLDER = 12
MAX_LAYERS = 12

BREACHES = {
    "a driver imports the daemon": ("drivers/otolith_drivers/base.py", "import otolith.machine"),
    "the plant imports the twin": ("drivers/otolith_drivers/plant/dc_motor.py", "import otolith.twin.model"),
    "adapt reads a clock": ("daemon/otolith/adaptation/adapt.py", "import time"),
    "estimation opens a file": ("daemon/otolith/estimation/minimisers.py", "import pathlib"),
    "a machine of the service opens a socket": ("daemon/otolith/runtime/hall/machine.py", "import socket"),
    "the replay of a segment reads a clock": ("daemon/otolith/runtime/segment.py", "import time"),
    "health publishes": ("daemon/otolith/health/status.py", "import zenoh"),
    "the twin imports the estimation": ("daemon/otolith/twin/definition.py", "import otolith.estimation.problem"),
    "the site reads a state directory": ("daemon/otolith/site/hall.py", "import otolith.storage.state_store"),
    "acquisition imports publishing": ("daemon/otolith/acquisition/ring.py", "import otolith.publishing.recorder"),
}


def lint(folder: Path) -> "subprocess.CompletedProcess[str]":
    environment = {"PYTHONPATH": f"{folder / 'daemon'}:{folder / 'drivers'}", "PATH": "/usr/bin:/bin"}
    command = [str(LINTER), "--config", str(folder / "pyproject.toml"), "--no-cache"]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    for name in ("daemon", "drivers"):
        shutil.copytree(ROOT / name, tmp_path / name)
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    return tmp_path


@pytest.mark.parametrize("breach", BREACHES)
def test_a_broken_import_rule_fails(copy: Path, breach: str) -> None:
    name, line = BREACHES[breach]
    assert lint(copy).returncode == 0
    file = copy / name
    file.write_text(f"{file.read_text(encoding='utf-8')}\n{line}\n", encoding="utf-8")
    result = lint(copy)
    assert result.returncode == 1, result.stdout
    assert "BROKEN" in result.stdout


def test_the_import_contract_has_few_layers() -> None:
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"][
        "contracts"
    ]
    (layers,) = [contract["layers"] for contract in contracts if contract["type"] == "layers"]
    assert len(layers) <= MAX_LAYERS


def test_a_folder_has_a_dozen_modules_at_most() -> None:
    folders = Counter(path.parent for path in SOURCES if path.name != "__init__.py")
    assert {folder.name: count for folder, count in folders.items() if count > MAX_MODULES_IN_A_FOLDER} == {}


@pytest.mark.parametrize("root", ["daemon", "drivers", "tests", "benchmarks"])
def test_no_file_is_longer_than_one_idea(root: str) -> None:
    lengths = {path.name: len(path.read_text(encoding="utf-8").splitlines()) for path in (ROOT / root).rglob("*.py")}
    assert {name: length for name, length in lengths.items() if length > MAX_FILE_LINES} == {}


def test_no_class_name_is_used_twice() -> None:
    names = [name for path in SOURCES
             for name in re.findall(r"^ *class (\w+)", path.read_text(encoding="utf-8"), re.MULTILINE)]  # fmt: skip
    assert [name for name, count in Counter(names).items() if count > 1] == []


def test_the_can_driver_has_no_way_to_send() -> None:
    modules = sorted((ROOT / "drivers" / "otolith_drivers" / "canbus").glob("*.py"))
    texts = {module.name: module.read_text(encoding="utf-8") for module in modules}
    assert "import can" in texts["channel.py"]
    assert [name for name, text in texts.items() if ".send(" in text] == []
