"""The rules of the house hold, and each one fails when it is broken."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
LINTER = Path(sys.executable).with_name("lint-imports")
FILE_LIMIT = 600  # lines

BREACHES = {
    "a driver imports the daemon": ("drivers/otolith_drivers/base.py", "import otolith.machine"),
    "the plant imports the twin": ("drivers/otolith_drivers/plant/dc_motor.py", "import otolith.twin.model"),
    "the heart reads a clock": ("daemon/otolith/adaptation/adapt.py", "import time"),
    "adaptation opens a file": ("daemon/otolith/estimation/particle_swarm.py", "import pathlib"),
    "health publishes": ("daemon/otolith/health/status.py", "import zenoh"),
    "the twin knows the estimation": ("daemon/otolith/twin/definition.py", "import otolith.estimation.problem"),
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
def test_a_breach_is_found(copy: Path, breach: str) -> None:
    name, line = BREACHES[breach]
    assert lint(copy).returncode == 0
    file = copy / name
    file.write_text(f"{file.read_text(encoding='utf-8')}\n{line}\n", encoding="utf-8")
    found = lint(copy)
    assert found.returncode == 1, found.stdout
    assert "BROKEN" in found.stdout


def test_the_driver_has_no_way_to_send() -> None:
    text = (ROOT / "drivers" / "otolith_drivers" / "canbus" / "driver.py").read_text(encoding="utf-8")
    assert "import can" in text
    assert ".send(" not in text


@pytest.mark.parametrize("root", ["daemon", "drivers", "tests"])
def test_no_file_grows_past_a_few_screens(root: str) -> None:
    long = {path.name: count for path in (ROOT / root).rglob("*.py")
            if (count := len(path.read_text(encoding="utf-8").splitlines())) > FILE_LIMIT}  # fmt: skip
    assert long == {}
