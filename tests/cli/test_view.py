"""``otolith view``: which recordings it finds, and what it gives to the viewer, which a script stands in for."""

import os
import stat
import sys
import threading
import time
from pathlib import Path
from unittest.mock import Mock

import pytest
from click.testing import CliRunner, Result

from otolith.cli import common
from otolith.cli.machines import zone_of_machine
from otolith.cli.main import cli
from otolith.cli.operation import view as module
from otolith.cli.operation.view import END, HEADER_BYTES, MAGIC, MESSAGE
from tests.messages import assert_says
from tests.waiting import wait_for

STAMP = "%Y%m%dT%H%M%S"
BOUND = "--bind 127.0.0.1 --port auto"


@pytest.fixture
def services(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "services"
    folder.mkdir()
    monkeypatch.setattr(module, "SERVICES", folder)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "own"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv("STATE_DIRECTORY", raising=False)
    monkeypatch.setenv("DISPLAY", ":0")
    return folder


def test_a_user_without_a_name_is_told_which_group_may_read(services: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("getpass.getuser", Mock(side_effect=KeyError("uid not found")))
    assert "usermod -aG" in module.unreadable_text(services)


@pytest.fixture
def shown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A log of the arguments of the viewer; it finds every file whole that is not in a folder ``torn``."""
    program, log = tmp_path / "bin" / "rerun", tmp_path / "shown.txt"
    program.parent.mkdir()
    program.write_text(
        f"""#!{sys.executable}
import shutil, sys
if sys.argv[1:3] == ["rrd", "verify"]:
    torn = [path for path in sys.argv[3:] if "/torn/" in path]
    sys.exit("".join(f'"{{path}}": Missing RRD footer\\n' for path in torn) or 0)
if sys.argv[1:3] == ["rrd", "optimize"]:
    shutil.copy(sys.argv[4], sys.argv[6])
elif sys.argv[-1] == "-":
    open({str(log)!r}, "a").write(" ".join(sys.argv[1:]) + "\\n")
    while data := sys.stdin.buffer.read1():
        with open({str(log)!r} + ".data", "ab") as file:
            file.write(data)
        if data.endswith(b"close"):
            break
elif sys.argv[1:2] != ["analytics"]:
    open({str(log)!r}, "a").write(" ".join(sys.argv[1:]) + "\\n")
""",
        encoding="utf-8",
    )
    program.chmod(0o755)
    monkeypatch.setattr("sysconfig.get_path", lambda _: str(program.parent))
    return log


def made(folder: Path, key: str, age: float, mark: str = "") -> Path:
    """A file that ended ``age`` s ago, and began ten minutes before."""
    folder.mkdir(parents=True, exist_ok=True)
    end = time.time() - age
    path = folder / f"{key}-{time.strftime(STAMP, time.gmtime(end - 600.0))}-17{mark}.rrd"
    path.write_bytes(MAGIC + bytes(2_000_000))
    os.utime(path, (end, end))
    return path


def run(*arguments: str) -> Result:
    return CliRunner().invoke(cli, ["view", *arguments], standalone_mode=False)


def service_of_tokyo(services: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A recording of the instance ``press-3`` of the service; the machine in its file has another name."""
    file = services.with_name("etc") / "press-3.toml"
    file.parent.mkdir()
    file.write_text('[machine]\nsite = "hall"\nname = "motor"\ntimezone = "Asia/Tokyo"\n', encoding="utf-8")
    monkeypatch.setattr(common, "INSTALLED", file.parent)
    monkeypatch.setattr(common, "SERVICES", services)
    return made(services / "press-3" / "recordings", "hall.motor", 60.0)


@pytest.mark.parametrize("name", ["press-3", "motor", "hall.motor"])
@pytest.mark.parametrize("may_write", [True, False], ids=["root", "member of the group"])
def test_recordings_of_a_service_are_shown_to_all_who_may_read_them(
    services: Path, monkeypatch: pytest.MonkeyPatch, name: str, *, may_write: bool
) -> None:
    """The tests may run as root, who may write everywhere: ``os.access`` is replaced."""
    recording, real = service_of_tokyo(services, monkeypatch), os.access
    monkeypatch.setattr(os, "access", lambda path, mode: real(path, mode) and (may_write or not mode & os.W_OK))
    done = run(name, "--list")
    assert done.exception is None
    assert_says(done.stdout, "JST", str(recording))


@pytest.mark.parametrize("name", ["press-3", "motor"])
def test_what_a_command_finds_later_is_what_it_finds_at_first(
    services: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """``--live`` searches again and again: the zone of the machine must not make its state that of this user."""
    service_of_tokyo(services, monkeypatch)
    assert zone_of_machine(name) == "Asia/Tokyo"
    assert "STATE_DIRECTORY" not in os.environ
    newer = made(services / "press-3" / "recordings", "hall.motor", 0.0)
    assert module.Recordings.search(name).files[0].path == newer


def arguments_of(shown: Path) -> str:
    return shown.read_text(encoding="utf-8").splitlines()[-1]


def test_recordings_of_a_service_and_of_oneself_are_listed(services: Path, tmp_path: Path) -> None:
    service = made(services / "press-3" / "recordings", "hall.motor", 3600.0, "-event")
    own = made(tmp_path / "own" / "otolith" / "recordings", "site.pump", 60.0)
    other = own.with_name("replayed.rrd")
    other.write_bytes(MAGIC)
    os.utime(other, (1e9, 1e9))
    lines = run("--list").output.splitlines()
    assert [Path(line.split()[-1]) for line in lines] == [own, service, other]
    assert "10 min" in lines[0]
    assert "2.0 MB  site.pump" in lines[0]
    assert "event" in lines[1]
    assert lines[2].startswith(f"{time.strftime('%F %T %Z', time.localtime(1e9))}      - min       0.0 MB  -  ")
    assert len({line.index("/") for line in lines}) == 1
    assert [run(name, "--list").stdout.count("\n") for name in ("pump", "hall.motor", "motor", "press-3", "mot")] == [
        *[1] * 4,
        0,
    ]


def test_the_newest_or_all_of_a_span_are_opened_in_order(services: Path, shown: Path) -> None:
    folder = services / "press-3" / "recordings"
    paths = [made(folder, "hall.motor", hours * 3600.0 + 60.0) for hours in range(5)]
    made(folder, "hall.pump", 0.0)
    assert run("motor").exit_code == 0
    assert arguments_of(shown) == f"{BOUND} {paths[0]}"
    run("motor", "--since", "2h")
    assert arguments_of(shown) == f"{BOUND} {paths[1]} {paths[0]}"
    run("motor", "--since", "1d", "--web")
    assert arguments_of(shown) == f"{BOUND} --serve-web --web-viewer-port 0 " + " ".join(map(str, reversed(paths)))
    run(str(paths[3]))
    assert arguments_of(shown) == f"{BOUND} {paths[3]}"


def test_of_a_torn_file_the_viewer_gets_what_is_whole(services: Path, shown: Path) -> None:
    torn, whole = (
        made(services / "torn" / "recordings", "s.m", 99.0),
        made(services / "whole" / "recordings", "s.m", 9.0),
    )
    run("m", "--since", "1h")
    first, second = arguments_of(shown).split()[-2:]
    assert (Path(first).name, second) == (f"0-{torn.name}", str(whole))
    assert Path(first) != torn
    assert not Path(first).exists()  # it was a copy


def test_what_may_not_be_read_names_the_group(services: Path, monkeypatch: pytest.MonkeyPatch, shown: Path) -> None:
    """The tests may run as root, who may read everything: ``os.access`` is replaced."""
    path = made(services / "press-3" / "recordings", "hall.motor", 0.0)
    group = path.group()
    join = f"not readable for this user: join group {group}: 'sudo usermod -aG {group} "
    real = os.access
    closed = path.parent
    monkeypatch.setattr(os, "access", lambda place, mode: Path(place) != closed and real(place, mode))
    for name in ("motor", ""):
        error = str(run(name).exception)
        assert "no recording" in error
        assert f"{closed}: {join}" in error
    closed = path
    monkeypatch.setattr(Path, "open", lambda *_: (_ for _ in ()).throw(PermissionError(13, "Permission denied")))
    assert join in str(run(str(path)).exception)
    assert not shown.exists()


def test_errors_name_the_way_out(services: Path, shown: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert "no recording of motor since 20" in str(run("motor", "--since", "2h").exception)
    assert "write an age like 12h" in str(run("--since", "2 V").exception)
    (tmp_path / "other.rrd").write_text("nothing", encoding="utf-8")
    assert "not a Rerun recording" in str(run(str(tmp_path / "other.rrd")).exception)
    path = made(services / "press-3" / "recordings", "hall.motor", 0.0)
    assert "choose among the recordings of a machine" in str(run(str(path), "--since", "2h").exception)
    monkeypatch.delenv("DISPLAY")
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    assert "no display here: 'otolith view --web'" in str(run().exception)
    assert not shown.exists()
    program = Path(shown.parent / "bin" / "rerun")
    assert program.stat().st_mode & stat.S_IXUSR
    program.write_text("#!/bin/sh\nexit 1\n", encoding="utf-8")  # its binary was removed
    assert "is not installed" in str(run("--web").exception)
    program.unlink()
    assert "is not installed" in str(run("--web").exception)


def message(text: bytes, kind: int = 1) -> bytes:
    return MESSAGE.pack(kind, len(text)) + text


def test_a_live_view_goes_on_with_what_is_added_and_with_the_next_file(services: Path, shown: Path) -> None:
    """A torn message and the end of a file are left out, as the viewer would take the next file for their rest."""
    header = MAGIC.ljust(HEADER_BYTES, b"+")
    folder, results, sent = services / "press-3" / "recordings", list[Result](), shown.with_name("shown.txt.data")
    first = made(folder, "hall.motor", 1200.0)
    first.write_bytes(header + message(b"one") + MESSAGE.pack(1, 9) + b"torn")
    made(folder, "hall.pump", 0.0)
    command = threading.Thread(target=lambda: results.append(run("motor", "--live", "--web")), daemon=True)
    command.start()
    expected = header + message(b"one")
    wait_for(lambda: sent.exists() and sent.read_bytes() == expected, 60.0)
    marked = first.rename(first.with_name(f"{first.stem}-event.rrd"))
    with marked.open("ab") as file:
        file.write(b" rest" + message(b"two") + message(b"index", END) + b"footer")
    expected += message(b"torn rest") + message(b"two")
    wait_for(lambda: sent.read_bytes() == expected, 60.0)
    second = made(folder, "hall.motor", -60.0)
    second.write_bytes(header + message(b"three") + message(b"close"))
    os.utime(second, (time.time() + 60.0,) * 2)
    command.join(60.0)
    assert sent.read_bytes() == expected + header + message(b"three") + message(b"close")
    assert results[0].return_value == 0
    assert arguments_of(shown) == f"{BOUND} --serve-web --web-viewer-port 0 -"
    assert "without --since and --list" in str(run("motor", "--live", "--list").exception)


def test_what_to_open_in_a_browser_is_one_line(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """Lines of the viewer of Rerun 0.41, with its colours."""
    address = "http://127.0.0.1:44339?url=rerun%2Bhttp%3A%2F%2Flocalhost%3A9876%2Fproxy"
    lines = (
        "\x1b[2m2026-11-27T15:33:58.328606Z\x1b[0m \x1b[32m INFO\x1b[0m \x1b[2mre_importer\x1b[0m: Loading",
        f"\x1b[2m2026-11-27T15:33:58.376215Z\x1b[0m \x1b[32m INFO\x1b[0m re_sdk: Hosting - connect at {address}",
        "2026-11-27T15:33:58.376215Z ERROR re_grpc: no port is free",
    )
    script = tmp_path / "viewer"
    script.write_text(f"#!{sys.executable}\nprint({chr(10).join(lines)!r})\n", encoding="utf-8")
    script.chmod(0o755)
    with module._started([str(script)], {}, web=True) as viewer:
        viewer.wait()
    printed = capsys.readouterr()
    (line,) = printed.out.splitlines()
    assert_says(line, f"open {address}", "-L 44339:127.0.0.1:44339", "-L 9876:127.0.0.1:9876")
    assert printed.err.splitlines() == ["2026-11-27T15:33:58.376215Z ERROR re_grpc: no port is free"]
