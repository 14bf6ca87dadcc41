"""``otolith install`` into a folder: the files of the service, again, and what the drop-in allows."""

import os
import re
import shutil
import subprocess
import tomllib
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from otolith.cli.common import shipped_directory
from otolith.cli.main import cli
from otolith.cli.operation.install import HALL_UNIT, UNIT, _commands, _run, drop_in, named_files
from otolith.machine import load_machine
from otolith.outlet_tables import OutletsTable
from otolith_drivers.canbus import bus as can_bus
from otolith_drivers.errors import ConfigurationError, ServiceError
from tests.conftest import EXAMPLES
from tests.messages import assert_says, raises_saying

LOOPBACK = ("tcp/127.0.0.1:7447",)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    for name in ("dc-motor.toml", "dc-motor.dbc"):
        shutil.copy(EXAMPLES / name, tmp_path)
    return (tmp_path / "dc-motor.toml").rename(tmp_path / "press-3.toml")


def installed(file: Path, root: Path, *options: str) -> str:
    result = CliRunner().invoke(cli, ["install", str(file), "--root", str(root), *options], catch_exceptions=False)
    assert result.exit_code == 0
    return result.output


def test_every_step_is_shown_and_idempotent(file: Path, tmp_path: Path) -> None:
    root = tmp_path / "root"
    shown = installed(file, root, "--dry-run")
    assert not root.exists()
    names = (
        "etc/otolith/press-3.toml",
        "etc/otolith/dc-motor.dbc",
        f"etc/systemd/system/{UNIT}",
        "etc/systemd/system/otolith@press-3.service.d/machine.conf",
        "usr/lib/sysusers.d/otolith.conf",
    )
    assert all(f"to write: {root / name}" in shown for name in names)
    assert "to run: systemd-sysusers" in shown
    assert "compile /etc/otolith/press-3.toml" in shown
    installed(file, root)
    assert {str(path.relative_to(root)) for path in root.rglob("*") if path.is_file()} == set(names)
    assert (root / names[2]).read_bytes() == (shipped_directory("systemd") / UNIT).read_bytes()
    assert (root / names[0]).stat().st_mode & 0o777 == 0o644
    again = installed(file, root)
    assert again.count("unchanged: ") == len(names)
    file.write_text(file.read_text(encoding="utf-8") + "# changed\n", encoding="utf-8")
    assert f"replace: {root / names[0]}" in installed(file, root)
    assert "# changed" not in (root / f"{names[0]}~").read_text(encoding="utf-8")


def test_the_service_can_read_its_files_whatever_the_umask_of_root(file: Path, tmp_path: Path) -> None:
    before = os.umask(0o077)
    try:
        installed(file, tmp_path / "root")
    finally:
        os.umask(before)
    paths = [path for path in (tmp_path / "root").rglob("*") if path != tmp_path]
    assert {path.stat().st_mode & 0o777 for path in paths if path.is_dir()} == {0o755}
    assert {path.stat().st_mode & 0o777 for path in paths if path.is_file()} == {0o644}


def test_what_others_may_not_read_stays_so(file: Path, tmp_path: Path) -> None:
    """Commands of the machine file and files that it names may have secrets."""
    root, dbc = tmp_path / "root", file.with_name("dc-motor.dbc")
    copies = [root / "etc/otolith" / path.name for path in (file, dbc)]
    installed(file, root)
    for path in (file, dbc):
        path.chmod(0o600)
    assert installed(file, root, "--dry-run").count("to restrict: ") == len(copies)
    assert [copy.stat().st_mode & 0o777 for copy in copies] == [0o644, 0o644]
    output = installed(file, root)
    assert [copy.stat().st_mode & 0o777 for copy in copies] == [0o640, 0o640]
    assert "to run: chgrp otolith /etc/otolith/press-3.toml /etc/otolith/dc-motor.dbc" in output
    assert "restrict: " not in installed(file, root)
    file.write_text(file.read_text(encoding="utf-8") + "# changed\n", encoding="utf-8")
    installed(file, root)
    kept = copies[0].with_name(f"{file.name}~")
    assert [path.stat().st_mode & 0o777 for path in (copies[0], kept)] == [0o640, 0o640]


def test_what_others_may_no_longer_read_is_not_kept_for_them_either(file: Path, tmp_path: Path) -> None:
    root = tmp_path / "root"
    installed(file, root)
    copy = root / "etc/otolith" / file.name
    before = copy.read_bytes()
    file.write_text(file.read_text(encoding="utf-8") + "# changed\n", encoding="utf-8")
    file.chmod(0o600)
    installed(file, root)
    kept = copy.with_name(f"{file.name}~")
    assert kept.read_bytes() == before
    assert [path.stat().st_mode & 0o777 for path in (copy, kept)] == [0o640, 0o640]


def test_the_service_may_enter_the_folders_that_are_there(file: Path, tmp_path: Path) -> None:
    """An administrator, or root with another umask, has made them for himself alone; other users stay outside."""
    root = tmp_path / "root"
    folders = [root / name for name in ("etc/otolith", "var/lib/otolith")]
    for folder in folders:
        folder.mkdir(parents=True)
        folder.chmod(0o700)
    for options in (["--dry-run"], []):
        output = installed(file, root, *options)
        assert "to run: chgrp otolith /etc/otolith /var/lib/otolith\nto run: chmod g+x /etc/otolith " in output
        steps = ("systemd-sysusers", "chgrp", "chmod", "compile")
        assert sorted(steps, key=output.index) == list(steps)
        assert [folder.stat().st_mode & 0o777 for folder in folders] == [0o700, 0o700]  # --root runs no command
    for folder in folders:
        folder.chmod(0o711)
    assert "chmod" not in installed(file, root)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can become another user")
def test_a_program_that_the_service_may_not_run_is_named(tmp_path: Path) -> None:
    """Root has made the environment with a umask that closes it."""
    program = Path(shutil.copy("/bin/true", tmp_path / "otolith"))
    tmp_path.chmod(0o700)
    with raises_saying(ServiceError, f"{program}", "'daemon'", "run"):
        _run([str(program)], "daemon")


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a folder to a group")
def test_a_folder_of_another_group_is_not_taken_from_it(file: Path, tmp_path: Path) -> None:
    root = tmp_path / "root"
    folder = root / "etc/otolith"
    folder.mkdir(parents=True)
    folder.chmod(0o750)
    os.chown(folder, 0, 65533)
    with raises_saying(ServiceError, f"{folder}", "'otolith'", f"chmod o+x {folder}"):
        installed(file, root, "--dry-run")
    assert list(folder.iterdir()) == []


def test_a_file_that_another_machine_names_is_not_replaced_silently(file: Path, tmp_path: Path) -> None:
    root, dbc = tmp_path / "root", tmp_path / "dc-motor.dbc"
    installed(file, root)
    other = Path(shutil.copy(file, tmp_path / "press-4.toml"))
    assert "warning" not in installed(other, root)
    dbc.write_bytes(dbc.read_bytes() + b"\n")
    assert "dc-motor.dbc is also a file of press-3.toml: if they need another" in installed(other, root, "--dry-run")
    assert "dc-motor.dbc is also a file of press-3.toml: if they need another" in installed(other, root)
    assert "warning" not in installed(other, root)


@pytest.mark.parametrize(
    ("driver", "limit"),
    [
        ('type = "can"\nchannel = "can0"', 1.0),
        ('type = "modbus"\nhost = "192.168.0.10"', 1.0),
        ('type = "modbus"\nserial = "/dev/ttyUSB0"', 0.7),
        ('type = "plant"\nscenario = "plant.toml"', 0.6),
        ('type = "modbus"\nhost = "drive.plant.local"', 1.1),  # its address is not known: none is denied
        ('type = "can"\ninterface = "pcan"', 1.3),  # its library may open any socket
    ],
)
def test_the_shipped_unit_is_hardened(file: Path, tmp_path: Path, driver: str, limit: float) -> None:
    """Exposure by systemd's own measure, with the drop-in of the machine."""
    installed(file, tmp_path)
    folder = tmp_path / "etc/systemd/system/otolith@press-3.service.d"
    text = drop_in("press-3", [tomllib.loads(driver)], ("local",), ())
    (folder / "machine.conf").write_text(text, encoding="utf-8")
    assert exposure(tmp_path, "press-3") <= limit


def test_readers_whose_network_is_in_a_drop_in_of_ones_own_leave_1_0(file: Path, tmp_path: Path) -> None:
    """As docs/service.md says."""
    installed(file, tmp_path)
    folder = tmp_path / "etc/systemd/system/otolith@press-3.service.d"
    text = drop_in("press-3", [{"type": "plant"}], ("local", "tls/0.0.0.0:7447"), ("tcp/router.plant.local:7447",))
    (folder / "machine.conf").write_text(text, encoding="utf-8")
    assert exposure(tmp_path, "press-3") == 1.1
    own = "[Service]\nIPAddressDeny=any\nIPAddressAllow=localhost 192.168.7.0/24\n"
    (folder / "override.conf").write_text(own, encoding="utf-8")
    assert exposure(tmp_path, "press-3") <= 1.0


def test_readers_whose_networks_the_machine_file_names_leave_1_0(file: Path, tmp_path: Path) -> None:
    installed(file, tmp_path)
    text = drop_in("press-3", [{"type": "plant"}], ("tls/0.0.0.0:7447",), (), networks=("192.168.7.0/24",))
    path = tmp_path / "etc/systemd/system/otolith@press-3.service.d/machine.conf"
    path.write_text(text, encoding="utf-8")
    assert exposure(tmp_path, "press-3") <= 1.0


def test_the_service_accepts_packets_from_the_networks_of_its_readers_alone(file: Path, tmp_path: Path) -> None:
    table = '[zenoh]\nlisten = ["tcp/0.0.0.0:7447"]\naccess = { networks = ["192.168.7.0/24", "fd00::/8"] }\n'
    file.write_text(file.read_text(encoding="utf-8") + table, encoding="utf-8")
    installed(file, tmp_path)
    text = (tmp_path / "etc/systemd/system/otolith@press-3.service.d/machine.conf").read_text(encoding="utf-8")
    assert "IPAddressDeny=any\nIPAddressAllow=localhost\n" in text
    assert text.endswith("IPAddressAllow=192.168.7.0/24\nIPAddressAllow=fd00::/8\n")
    driver = {"type": "modbus", "host": "drive"}
    text = drop_in("press-3", [driver], ("tcp/0.0.0.0:7447",), (), networks=("192.168.7.0/24",))
    assert re.search("# No IPAddressDeny.*'drive'", text)


@pytest.mark.parametrize("bus", [True, False], ids=["vcan0", "no vcan0"])
@pytest.mark.parametrize("name", sorted(path.stem for path in EXAMPLES.glob("*.toml")))
def test_each_shipped_machine_file_is_exposed_at_most_1_0(
    tmp_path: Path, name: str, bus: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(can_bus, "kernel_has", lambda channel: bus)
    installed(EXAMPLES / f"{name}.toml", tmp_path)
    limit = 1.2 if name == "dc-motor-two-buses" and bus else 1.0  # CAN of the kernel and Modbus over IP
    assert exposure(tmp_path, name) <= limit


def exposure(root: Path, name: str) -> float:
    """Exposure of the installed unit or instance ``name``, from 0 to 10."""
    if shutil.which("systemd-analyze") is None:
        pytest.skip("no systemd-analyze here")
    unit = name if name.endswith(".service") else f"otolith@{name}.service"
    command = ["systemd-analyze", "security", "--offline=yes", f"--root={root}", unit]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    exposure = re.search(r"exposure level for \S+: ([\d.]+)", done.stdout)
    assert exposure is not None, done.stderr
    return float(exposure[1])


@pytest.fixture
def hall(tmp_path: Path) -> Path:
    """A directory with two machines, one of them on a serial line, and a file of the service."""
    folder = tmp_path / "machines"
    folder.mkdir()
    for name in ("dc-motor.toml", "dc-motor.dbc", "pump-vfd.toml"):
        shutil.copy(EXAMPLES / name, folder)
    (folder / "service.toml").write_text('[zenoh]\nlisten = ["tcp/127.0.0.1:7450"]\n', encoding="utf-8")
    return folder


def test_a_directory_is_one_service(hall: Path, tmp_path: Path) -> None:
    root = tmp_path / "root"
    names = {f"etc/otolith/hall/{path.name}" for path in hall.iterdir()}
    names |= {f"etc/systemd/system/{HALL_UNIT}", "etc/systemd/system/otolith.service.d/machine.conf"}
    names |= {"usr/lib/sysusers.d/otolith.conf"}
    output = installed(hall, root)
    assert {str(path.relative_to(root)) for path in root.rglob("*") if path.is_file()} == names
    assert "compile /etc/otolith/hall\n" in output
    assert output.endswith("systemctl enable --now otolith\n")
    assert installed(hall, root).count("unchanged: ") == len(names)
    text = (root / "etc/systemd/system/otolith.service.d/machine.conf").read_text(encoding="utf-8")
    for file in ("dc-motor.toml", "pump-vfd.toml"):
        needed = {drop for drop in drop_in_of(hall / file) if "Allow=" in drop}
        assert needed <= set(text.splitlines()), file
    sockets = [line for line in text.splitlines() if line.startswith("RestrictAddressFamilies=AF")]
    assert sockets == ["RestrictAddressFamilies=AF_UNIX AF_INET AF_INET6"]


def drop_in_of(file: Path) -> list[str]:
    machine = load_machine(file).file
    return drop_in(file.stem, machine.drivers, machine.zenoh.listen, machine.zenoh.connect).splitlines()


def test_the_unit_of_a_hall_is_as_strict_as_that_of_a_machine(hall: Path, tmp_path: Path) -> None:
    """It differs in paths and in what grows with the number of machines."""
    alone, several = (
        dict.fromkeys((shipped_directory("systemd") / unit).read_text(encoding="utf-8").splitlines())
        for unit in (UNIT, HALL_UNIT)
    )
    differing = {line.partition("=")[0] for line in {*alone} ^ {*several} if not line.startswith("#")}
    own = {"Description", "ExecStart", "StateDirectory", "RuntimeDirectory"}
    assert differing == {*own, "TimeoutStartSec", "TimeoutStopSec", "LimitNOFILE", "MemoryMax"}
    installed(hall, tmp_path / "both")
    assert exposure(tmp_path / "both", "otolith.service") <= 1.2  # a device and IP addresses
    (hall / "pump-vfd.toml").unlink()
    installed(hall, tmp_path / "network")
    assert exposure(tmp_path / "network", "otolith.service") <= 1.0


def test_services_share_one_cache_of_kernels() -> None:
    for unit in (UNIT, HALL_UNIT):
        text = (shipped_directory("systemd") / unit).read_text(encoding="utf-8")
        assert "\nCacheDirectory=otolith\nCacheDirectoryMode=0700\n" in text
        command, user = _commands(Path("/etc/otolith/press-3.toml"), [], [])[-2]
        assert (command[-1], command[command.index("-m") + 1], user) == ("/var/cache/otolith", "0700", None)


def test_readers_of_one_machine_of_a_hall_whose_networks_are_not_known_are_not_shut_out(
    hall: Path, tmp_path: Path
) -> None:
    table = '[zenoh]\nlisten = ["tcp/0.0.0.0:7447"]\naccess = {{ networks = {} }}\n'
    conf = "etc/systemd/system/otolith.service.d/machine.conf"
    motor = hall / "dc-motor.toml"
    (hall / "pump-vfd.toml").unlink()
    whole = motor.read_text(encoding="utf-8")
    motor.write_text(whole + table.format('["192.168.7.0/24"]'), encoding="utf-8")
    installed(hall, tmp_path / "known")
    assert "IPAddressAllow=192.168.7.0/24" in (tmp_path / "known" / conf).read_text(encoding="utf-8")
    shutil.copy(motor, hall / "other.toml")
    (hall / "other.toml").write_text(
        whole.replace('"dc-motor"', '"other"', 1) + '[zenoh]\nlisten = ["tcp/0.0.0.0:1"]\n'
    )
    installed(hall, tmp_path / "unknown")
    assert "\nIPAddressDeny" not in (tmp_path / "unknown" / conf).read_text(encoding="utf-8")


def test_a_machine_is_not_installed_twice_silently(hall: Path, tmp_path: Path) -> None:
    root = tmp_path / "root"
    assert "warning" not in installed(hall, root)
    shutil.copy(hall / "dc-motor.toml", tmp_path / "press-3.toml")
    shutil.copy(hall / "dc-motor.dbc", tmp_path)
    output = installed(tmp_path / "press-3.toml", root)
    assert_says(output, "warning", "etc/otolith/hall/dc-motor.toml", "same machine", "disable otolith")
    assert_says(installed(hall, root), "warning", "etc/otolith/press-3.toml", "disable otolith@press-3")
    (hall / "dc-motor.toml").unlink()
    assert_says(installed(hall, root), "warning", "etc/otolith/hall/dc-motor.toml", "delete it")


def test_the_file_of_the_service_that_is_there_holds_for_a_machine_that_is_added(file: Path, tmp_path: Path) -> None:
    there = tmp_path / "root" / "etc/otolith/service.toml"
    there.parent.mkdir(parents=True)
    there.write_text('[zenoh]\nlisten = ["tcp/0.0.0.0:7450"]\n', encoding="utf-8")
    installed(file, tmp_path / "root")
    conf = tmp_path / "root" / "etc/systemd/system/otolith@press-3.service.d/machine.conf"
    assert "AF_INET " in conf.read_text(encoding="utf-8")
    assert "\nIPAddressDeny" not in conf.read_text(encoding="utf-8")


def test_a_file_of_the_service_that_comes_names_the_machines_for_which_it_holds_too(file: Path, tmp_path: Path) -> None:
    root, beside = tmp_path / "root", tmp_path / "b"
    installed(file, root)
    beside.mkdir()
    shutil.copy(tmp_path / "dc-motor.dbc", beside)
    second = beside / "press-4.toml"
    second.write_text(file.read_text(encoding="utf-8").replace('"dc-motor"', '"press_4"', 1), encoding="utf-8")
    (beside / "topics").write_text("of the outlets\n", encoding="utf-8")
    (beside / "service.toml").write_text(
        '[outlets.prometheus]\n[outlets.webhook]\nurl = "https://tickets.local/"\nsecret_file = "topics"\n',
        encoding="utf-8",
    )
    (beside / "topics").chmod(0o600)
    for options in (["--dry-run"], []):
        output = installed(second, root, *options)
        (line,) = [line for line in output.splitlines() if line.startswith("warning")]
        assert_says(line, f"{root}/etc/otolith/service.toml", "press-3.toml", "holds for them", "install them again")
    assert "warning" not in installed(second, root)
    (beside / "topics").write_text("others\n", encoding="utf-8")
    assert_says(installed(second, root), f"{root}/etc/otolith/topics is also a file of press-3.toml: ")
    unit = root / "etc/systemd/system/otolith@press-3.service.d/machine.conf"
    before = unit.read_text(encoding="utf-8")
    installed(file, root)
    assert unit.read_text(encoding="utf-8") != before  # its outlets may pass on
    (root / "etc/otolith/press-3.toml").unlink()
    (beside / "service.toml").write_text("[history]\ndays = 3\n", encoding="utf-8")
    assert "warning" not in installed(second, root)


def test_a_file_of_the_service_that_is_no_longer_there_is_named(hall: Path, tmp_path: Path) -> None:
    root = tmp_path / "root"
    assert "warning" not in installed(hall, root, "--dry-run")
    installed(hall, root)
    (hall / "service.toml").write_text("[history]\ndays = 3\n", encoding="utf-8")
    assert "warning" not in installed(hall, root)
    (hall / "service.toml").unlink()
    (line,) = [line for line in installed(hall, root).splitlines() if line.startswith("warning")]
    assert_says(line, f"{root}/etc/otolith/hall/service.toml", f"not in {hall}", "stays in force", "delete it")
    (root / "etc/otolith/hall/service.toml").unlink()
    assert "warning" not in installed(hall, root)


def test_a_wrong_file_of_a_directory_installs_nothing(hall: Path, file: Path, tmp_path: Path) -> None:
    (hall / "service.toml").write_text("[history]\ndays = 0\n", encoding="utf-8")
    with raises_saying(ConfigurationError, "service.toml:2", "history.days"):
        installed(hall, tmp_path / "root")
    for path in hall.glob("*.toml"):
        path.unlink()
    with raises_saying(ConfigurationError, str(hall), "no machine file"):
        installed(hall, tmp_path / "root")
    with raises_saying(ConfigurationError, "hall.toml", "another name"):
        installed(file.rename(tmp_path / "hall.toml"), tmp_path / "root")
    assert not (tmp_path / "root").exists()


def test_a_wrong_machine_file_installs_nothing(file: Path, tmp_path: Path) -> None:
    file.write_text("[machine]\n", encoding="utf-8")
    with pytest.raises(ConfigurationError):
        installed(file, tmp_path / "root")
    assert not (tmp_path / "root").exists()
    odd = file.rename(tmp_path / "a b.toml")
    with pytest.raises(ConfigurationError, match="becomes that of the service"):
        installed(odd, tmp_path / "root")


def test_a_file_elsewhere_is_not_copied(file: Path, tmp_path: Path) -> None:
    (tmp_path / "deep").mkdir()
    deep = tmp_path / "deep" / "press-3.toml"
    text = file.read_text(encoding="utf-8").replace('"dc-motor.dbc"', '"../dc-motor.dbc"')
    deep.write_text(text, encoding="utf-8")
    with raises_saying(ConfigurationError, "folder of the machine file"):
        named_files(deep)
    deep.write_text(text.replace("../dc-motor.dbc", "../deep/dc-motor.dbc"), encoding="utf-8")
    shutil.copy(tmp_path / "dc-motor.dbc", tmp_path / "deep")
    with raises_saying(ConfigurationError, "folder of the machine file"):
        named_files(deep)  # /etc/otolith/../deep would be another folder
    (tmp_path / "deep" / "link.dbc").symlink_to(tmp_path / "dc-motor.dbc")
    deep.write_text(text.replace("../dc-motor.dbc", "link.dbc"), encoding="utf-8")
    with raises_saying(ConfigurationError, "folder of the machine file"):
        named_files(deep)


def test_the_drop_in_allows_what_the_file_names() -> None:
    serial = drop_in("pump", [{"type": "modbus", "serial": "/dev/ttyUSB0"}], LOOPBACK, ())
    assert {"PrivateDevices=no", "DevicePolicy=closed", "DeviceAllow=/dev/ttyUSB0 rw", "SupplementaryGroups=dialout",
            "IPAddressDeny=any", "IPAddressAllow=localhost"} <= set(serial.splitlines())  # fmt: skip
    drive = drop_in("drive", [{"type": "modbus", "host": "192.168.0.10"}], LOOPBACK, ("tcp/[fd00::1]:7447",))
    assert "PrivateDevices" not in drive
    assert [line for line in drive.splitlines() if "IPAddressAllow" in line] == [
        "IPAddressAllow=localhost", "IPAddressAllow=fd00::1", "IPAddressAllow=192.168.0.10"]  # fmt: skip
    missing = {"type": "can", "channel": "vcan99"}
    assert "IPAddressAllow=multicast" in drop_in("press", [missing], LOOPBACK, ())
    assert "multicast" not in drop_in("press", [{"type": "can", "channel": "can0"}], LOOPBACK, ())
    adapter = drop_in("press", [{"type": "can", "interface": "slcan", "channel": "/dev/ttyACM0@115200"}], LOOPBACK, ())
    assert "DeviceAllow=/dev/ttyACM0 rw" in adapter


@pytest.mark.parametrize(
    ("outlets", "allowed"),
    [
        ({"prometheus": {}}, ["localhost"]),
        ({"mqtt": {"host": "192.168.0.9"}, "opcua": {}}, ["localhost", "192.168.0.9"]),
        ({"webhook": {"url": "https://tickets.plant.local/a"}}, []),  # its address is not known: none is denied
        ({"mail": {"host": "mail.plant.local", "sender": "a@b.c", "to": ["a@b.c"]}}, []),
        ({"prometheus": {"listen": "0.0.0.0:8421", "hosts": ["press-3"]}}, []),
    ],
)
def test_the_service_reaches_where_its_outlets_pass_on_to(outlets: dict[str, Any], allowed: list[str]) -> None:
    table = OutletsTable.model_validate(outlets)
    driver = {"type": "can", "channel": "can0"}
    lines = drop_in("press", [driver], ("local",), (), networks=(), outlets=[table]).splitlines()
    assert "RestrictAddressFamilies=AF_UNIX AF_CAN AF_INET AF_INET6" in lines
    assert [line.partition("=")[2] for line in lines if line.startswith("IPAddressAllow")] == allowed
    assert ("IPAddressDeny=any" in lines) == bool(allowed)


@pytest.mark.parametrize(
    ("driver", "listen", "sockets"),
    [
        ({"type": "plant"}, ("local",), "AF_UNIX"),
        ({"type": "modbus", "serial": "/dev/ttyUSB0"}, ("local",), "AF_UNIX"),
        ({"type": "can", "interface": "slcan", "channel": "/dev/ttyACM0"}, ("local",), "AF_UNIX"),
        ({"type": "can", "channel": "can0"}, ("local",), "AF_UNIX AF_CAN"),
        ({"type": "can", "channel": "vcan99"}, ("local",), "AF_UNIX AF_INET AF_INET6"),  # UDP multicast instead
        ({"type": "can", "channel": "can0"}, LOOPBACK, "AF_UNIX AF_CAN AF_INET AF_INET6"),
        ({"type": "modbus", "host": "192.168.0.10"}, ("local",), "AF_UNIX AF_INET AF_INET6"),
        ({"type": "opcua", "endpoint": "opc.tcp://10.0.0.7:4840"}, ("local",), "AF_UNIX AF_INET AF_INET6"),
        ({"type": "can", "interface": "pcan"}, ("local",), None),  # whatever its library needs
        ({"type": "of-our-own"}, ("local",), None),
    ],
)
def test_the_service_may_open_the_sockets_that_it_needs(
    driver: dict[str, str], listen: tuple[str, ...], sockets: str | None
) -> None:
    lines = drop_in("press", [driver], listen, ()).splitlines()
    expected = [] if sockets is None else ["RestrictAddressFamilies=", f"RestrictAddressFamilies={sockets}"]
    assert [line for line in lines if line.startswith("RestrictAddressFamilies")] == expected
    assert ("PrivateNetwork=yes" in lines) == (sockets == "AF_UNIX")
    with_command = drop_in("press", [driver], listen, (), command=True)
    assert "PrivateNetwork" not in with_command  # it may send a mail


@pytest.mark.parametrize(
    ("driver", "listen", "connect"),
    [
        ({"type": "modbus", "host": "drive.plant.local"}, LOOPBACK, ()),
        ({"type": "can"}, ("tcp/0.0.0.0:7447",), ()),
        ({"type": "can"}, LOOPBACK, ("tcp/router:7447",)),
        ({"type": "of-our-own", "host": "10.0.0.1"}, LOOPBACK, ()),
    ],
)
def test_unknown_addresses_are_not_denied(
    driver: dict[str, str], listen: tuple[str, ...], connect: tuple[str, ...]
) -> None:
    text = drop_in("press", [driver], listen, connect)
    assert "\nIPAddressDeny" not in text
    assert "# No IPAddressDeny" in text
