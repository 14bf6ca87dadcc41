"""The outlets of a daemon, in the process that has them: which begin anew, and which go on."""

from pathlib import Path

from otolith.outlet_tables import MachineOutlets, OutletsTable, WebhookOutlet
from otolith.site.outlets.process import DaemonOutlets
from tests.messages import assert_says


def test_an_outlet_begins_anew_once_one_of_its_files_is_replaced(tmp_path: Path) -> None:
    secret, new = tmp_path / "secret", tmp_path / "new"

    def replace(mode: int) -> None:
        new.write_text("of this test\n", encoding="utf-8")
        new.chmod(mode)
        new.rename(secret)

    replace(0o600)
    table = OutletsTable(webhook=WebhookOutlet(url="https://tickets.local/", secret_file=Path("secret")))
    machine = MachineOutlets("hall", "press_1", tmp_path / "machine.toml", table)
    with DaemonOutlets() as outlets:
        for _ in range(2):
            outlets.take(machine.key, machine)
        (first,) = outlets.runners
        replace(0o600)
        outlets.take(machine.key, machine)
        (second,) = outlets.runners
        assert second is not first
        outlets.take(machine.key, machine)
        assert outlets.runners == [second]
        replace(0o604)
        outlets.take(machine.key, machine)
        assert_says((outlets.reasons() or {})[machine.key], str(secret), "chmod o-rwx")
