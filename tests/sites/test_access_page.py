"""The files of docs/site-commands.md: a machine, a site and a user, with the certificates that the page makes."""

import re
import ssl
import subprocess
import time
import tomllib
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from socket import SOCK_STREAM
from urllib.parse import urlencode

import pytest

from otolith.health.limits import Level
from otolith.machine_file import ZenohTable
from otolith.publishing.zenoh_config import Access
from otolith.site.words import words_in
from tests.cli.commands import otolith
from tests.conftest import free_port
from tests.publishing.test_commands import LIMIT
from tests.sites.machines import Daemon, report_of
from tests.sites.serving import Served, serving
from tests.sites.test_access import Forms
from tests.storage.histories import MACHINE, SITE
from tests.waiting import wait_for

PAGE = (Path(__file__).parents[2] / "docs" / "site-commands.md").read_text(encoding="utf-8")


def block(name: str) -> str:
    (found,) = re.findall(rf"^```toml\n# {name}\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)
    return str(found)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files of the page; hosts of this computer are added."""
    own = tmp_path_factory.mktemp("page")
    for line in re.findall(r"^    otolith (keys .*)$", PAGE, re.MULTILINE):
        words = [str(own / word) if word == "keys" and at else word for at, word in enumerate(line.split())]
        here = ["--host", "localhost", "--host", "127.0.0.1"] if "--host" in words else []
        assert otolith(*words, *here).exit_code == 0
    (line,) = re.findall(r"^    (openssl .*)$", PAGE, re.MULTILINE)
    subprocess.run([*line.split(), "-passout", "pass:x"], cwd=own, check=True, capture_output=True)
    assert (own / "anna.p12").stat().st_size > 0
    return own


@pytest.fixture(scope="module")
def machine(folder: Path) -> Iterator[Daemon]:
    table = ZenohTable.model_validate(tomllib.loads(block("machine.toml"))["zenoh"])
    endpoint = f"tls/127.0.0.1:{free_port(SOCK_STREAM)}"
    with closing(Daemon(folder, MACHINE, endpoint, Access(table, folder / "machine.toml"))) as own:
        yield own


@pytest.fixture(scope="module")
def anna(folder: Path, machine: Daemon) -> Iterator[Served]:
    text = block("site.toml").partition("[zenoh]")[2]
    assert "tls/press-3.local:7447" in text
    tables = "\n".join(line for line in text.splitlines() if not line.startswith("connect"))
    tls = ssl.create_default_context(cafile=folder / "keys" / "ca.crt")
    tls.load_cert_chain(folder / "keys" / "anna.crt", folder / "keys" / "anna.key")
    with serving(folder, machine.endpoint, tables=tables, tls=tls) as served:
        yield served


def test_the_user_of_the_page_decides_and_the_daemon_obeys(anna: Served, machine: Daemon) -> None:
    path = f"/machine/{SITE}/{MACHINE}"

    def is_shown() -> bool:
        machine.publish(report_of(end=time.time(), state=Level.ACT, events=(LIMIT,)))
        return "<form" in anna.ask(path).text

    wait_for(is_shown)
    page = anna.ask(path).text
    assert re.search(r"^    (otolith event acknowledge .*)$", PAGE, re.MULTILINE)[1] in page  # type: ignore[index]  # it is there
    (target, fields), *_ = Forms(page).found
    answer = anna.ask(target, "POST", urlencode(fields).encode(), origin=anna.address.rstrip("/"))
    assert words_in("en")["order_done"] in answer.text
    assert [note.by for note in machine.decisions.read().notes] == ["anna (site)"]
