"""The shipped unit of a hall under a booted systemd. Runs in the guest, as root."""

import re
from pathlib import Path

from tests.vm.conftest import run
from tests.vm.service import Hall, simulated_machine


def test_a_directory_of_machines_is_one_service(compiled: None, tmp_path: Path) -> None:
    """With its own user, sandbox and cache, a machine that is added by reload, and one that is wrong."""
    hall, folder = Hall(), tmp_path / "machines"
    folder.mkdir()
    for name in ("one", "two"):
        file = simulated_machine(folder, name=name)
        file.write_text(re.sub(r'(?m)^name = ".*"', f'name = "{name}"', file.read_text(), count=1), encoding="utf-8")
    (folder / "service.toml").write_text("[service]\nworkers = 1\n[recording]\nenabled = false\n", encoding="utf-8")
    hall.install(folder)
    try:
        run("systemctl", "enable", "--now", hall.unit, seconds=300.0)
        hall.wait_for_all({"one", "two"})
        shown = run("systemd-analyze", "security", "--no-pager", hall.unit)
        exposure = re.search(r"exposure level for \S+: ([\d.]+)", shown)
        assert exposure is not None
        assert float(exposure[1]) <= 1.0
        status = Path(f"/proc/{hall.shown('MainPID')}/status").read_text(encoding="ascii")
        user = run("id", "--user", "otolith").strip()
        assert f"\nUid:\t{user}\t{user}\t{user}\t{user}\n" in status
        assert [path.name for path in Path("/run/otolith").iterdir()] == ["hall"]
        assert not list(Path("/var/cache/otolith").glob("*/kernels"))
        text = (folder / "one.toml").read_text(encoding="utf-8")
        (folder / "three.toml").write_text(text.replace('name = "one"', 'name = "three"', 1), encoding="utf-8")
        hall.install(folder)
        (hall.file / "wrong.toml").write_text("[machine\n", encoding="utf-8")
        first = hall.shown("MainPID")
        run("systemctl", "reload", hall.unit)
        hall.wait_for_all({"one", "two", "three"})
        assert hall.shown("MainPID") == first
        run("systemctl", "stop", hall.unit)
        assert (hall.shown("ActiveState"), hall.shown("Result")) == ("inactive", "success")
        assert "Traceback" not in hall.log()
    finally:
        run("systemctl", "disable", "--now", hall.unit)
    del compiled
