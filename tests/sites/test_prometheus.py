"""Metrics, and the files for Prometheus, Alertmanager and Grafana: each metric that one names is there."""

import gzip
import http.client
import json
import re
import shutil
import socket
import subprocess
import time
import tomllib
import urllib.parse
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
from prometheus_client.parser import text_string_to_metric_families

from otolith.health.limits import Level
from otolith.health.schema import CostDocument, DriverDocument, ReportDocument
from otolith.outlet_tables import MachineOutlets, OutletsTable
from otolith.site.known import MAX_PARAMETERS, Knowledge, RefusedFor
from otolith.site.metrics import Metrics
from otolith.site.outlets.base import OutletStatus
from otolith.site.outlets.process import DaemonOutlets
from otolith.site.outlets.table import OUTLETS
from otolith.site.serving.counts import Counts, Hindered
from otolith.site.settings import SiteFile
from tests.conftest import free_port
from tests.hostile import HOSTILE
from tests.sites.machines import Stranger, raised, report_of, sent
from tests.sites.serving import serving
from tests.storage.histories import SITE, START
from tests.variants import often
from tests.waiting import wait_for, within

FILES = Path(__file__).parents[2] / "config" / "site"
NAME = re.compile(r"\botolith_\w+")
PROMETHEUS, PROMTOOL, AMTOOL = (shutil.which(name) for name in ("prometheus", "promtool", "amtool"))


def scraped(knowledge: Knowledge, now: float = START) -> str:
    return Metrics(knowledge).exposition({"queue": 1}, [OutletStatus("mqtt", is_tried=True)], now).decode()


def known(count: int = 1, **update: Any) -> Knowledge:
    knowledge = Knowledge()
    for index in range(count):
        report = report_of(f"press-{index}", state=Level.ACT, events=(raised(),))
        own = {"cost": CostDocument(latency_s=0.2), "driver": DriverDocument(up=True)} | update
        knowledge.take(*sent(report.model_copy(update=own)), START)
    return knowledge


def exported() -> set[str]:
    return {sample.name for family in text_string_to_metric_families(scraped(known())) for sample in family.samples}


def test_a_scrape_has_states_values_intervals_limits_and_counters() -> None:
    text = scraped(known())
    own, labels = f'machine="press-0",site="{SITE}"', f'machine="press-0",parameter="R_a",site="{SITE}",unit="ohm"'
    for line in (f'otolith_machine_state{{{own},state="act"}} 1.0', f"otolith_machine_up{{{own}}} 1.0",
                 f"otolith_events_open{{{own}}} 1.0", f"otolith_report_latency_seconds{{{own}}} 0.2",
                 f"otolith_source_up{{{own}}} 1.0", f"otolith_daemon_windows_total{{{own}}} 1.0",
                 f'otolith_parameter_low{{{labels}}} 6.48'):  # fmt: skip
        assert line in text


def test_names_keep_the_conventions_of_prometheus() -> None:
    for family in text_string_to_metric_families(scraped(known())):
        assert re.fullmatch(r"[a-z_]+", family.name)
        assert family.documentation.endswith(".")
        assert all(sample.name.endswith("_total") for sample in family.samples) == (family.type == "counter")


def test_who_was_refused_or_cut_is_counted_from_zero() -> None:
    counts = Counts({Hindered.HISTORY_BUSY: 3, Hindered.SLOW: 2})
    text = Metrics(known()).exposition({}, (), START, counts).decode()
    assert 'otolith_site_requests_refused_total{reason="history_busy"} 3.0' in text
    assert 'otolith_site_connections_cut_total{reason="slow"} 2.0' in text
    assert all(f'reason="{each.value}"}} ' in text for each in Hindered)


def test_a_silent_machine_has_a_state_and_no_values() -> None:
    text = scraped(known(), START + 3600.0)
    assert 'state="no_data"} 1.0' in text
    assert "otolith_parameter_value{" not in text
    assert f'otolith_machine_up{{machine="press-0",site="{SITE}"}} 0.0' in text


def test_no_text_ends_a_label_or_a_line() -> None:
    parameter = report_of().parameters["R_a"]
    texts = [text.encode(errors="replace").decode() for text in HOSTILE if len(text) < 1000]
    rows = {text: parameter.model_copy(update={"unit": text}) for text in texts}
    families = list(text_string_to_metric_families(scraped(known(parameters=rows))))
    (values,) = [family for family in families if family.name == "otolith_parameter_value"]
    assert {(sample.labels["parameter"], sample.labels["unit"]) for sample in values.samples} == {
        (text, text) for text in texts
    }


@pytest.mark.parametrize("number", [10**400, 2**63, -1])
@pytest.mark.parametrize("place", ["lost", "sequence", "previous"])
def test_a_number_that_no_float_has_is_refused_and_breaks_no_scrape(number: int, place: str) -> None:
    knowledge, document = known(), json.loads(report_of("press-1").to_json())
    own = {"counters": {place: number}} if place == "lost" else {place: number}
    content = json.dumps(document | own).encode()
    assert knowledge.take(f"otolith/{SITE}/press-1/report", content, START) is None
    assert knowledge.refused[RefusedFor.UNREADABLE] == 1
    assert 'machine="press-0"' in scraped(knowledge)


def test_a_machine_has_at_most_so_many_parameters_in_a_scrape() -> None:
    rows = {f"p{index}": report_of().parameters["R_a"] for index in range(3 * MAX_PARAMETERS)}
    assert scraped(known(parameters=rows)).count("\notolith_parameter_value{") == MAX_PARAMETERS


@pytest.mark.timed
def test_two_hundred_machines_are_scraped_in_50_ms() -> None:
    knowledge, times = known(200), []
    for _ in range(9):
        begun = time.perf_counter()
        scraped(knowledge)
        times.append(time.perf_counter() - begun)
    assert sorted(times)[4] <= within(0.05)


@pytest.mark.parametrize("name", ["prometheus-rules.yml", "grafana-dashboard.json"])
def test_each_metric_of_a_file_is_exported(name: str) -> None:
    named = set(NAME.findall((FILES / name).read_text(encoding="utf-8")))
    assert named
    assert named <= exported()


def test_the_example_of_a_site_is_one() -> None:
    text = (FILES / "site.toml").read_text(encoding="utf-8")
    SiteFile.model_validate(tomllib.loads(text))
    whole = re.sub(r"^# (?=[\[\w]+(?: =|\.|\]))", "", text, flags=re.MULTILINE)
    every = SiteFile.model_validate(tomllib.loads(whole))
    assert all(getattr(every.outlets, name) is not None for name in OUTLETS)
    assert set(OutletsTable.model_fields) == set(OUTLETS)


def test_panels_of_the_dashboard_cover_no_other_and_ask_the_chosen_source() -> None:
    board = json.loads((FILES / "grafana-dashboard.json").read_text(encoding="utf-8"))
    taken: set[tuple[int, int]] = set()
    for panel in board["panels"]:
        place = panel["gridPos"]
        cells = {(place["x"] + i, place["y"] + j) for i in range(place["w"]) for j in range(place["h"])}
        assert not cells & taken
        taken |= cells
        assert place["x"] + place["w"] <= 24
        assert {target["datasource"]["uid"] for target in panel["targets"]} == {"${datasource}"}
    assert len({panel["id"] for panel in board["panels"]}) == len(board["panels"])


@pytest.mark.skipif(PROMTOOL is None, reason="no promtool: apt install prometheus")
def test_promtool_takes_metrics_rules_and_configuration() -> None:
    assert PROMTOOL is not None
    assert subprocess.run([PROMTOOL, "check", "config", str(FILES / "prometheus.yml")], check=False).returncode == 0
    done = subprocess.run([PROMTOOL, "check", "metrics"], input=scraped(known()), text=True, check=False)
    assert done.returncode == 0


@pytest.mark.skipif(AMTOOL is None, reason="no amtool: apt install prometheus-alertmanager")
def test_amtool_takes_the_configuration_of_alertmanager() -> None:
    assert AMTOOL is not None
    assert subprocess.run([AMTOOL, "check-config", str(FILES / "alertmanager.yml")], check=False).returncode == 0


def answered(port: int, **headers: str) -> tuple[dict[str, str], bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10.0)
    try:
        connection.request("GET", "/metrics", headers={name.replace("_", "-"): text for name, text in headers.items()})
        answer = connection.getresponse()
        return {name.lower(): text for name, text in answer.getheaders()}, answer.read()
    finally:
        connection.close()


def test_who_takes_compressed_metrics_gets_them_also_at_an_address_of_their_own(tmp_path: Path) -> None:
    own = free_port(socket.SOCK_STREAM)
    table = f'[outlets.prometheus]\nlisten = "127.0.0.1:{own}"\n'
    stranger = Stranger("press-9")
    with closing(stranger), serving(tmp_path, stranger.endpoint, tables=table) as site:

        def is_known() -> bool:
            stranger.publish(report_of("press-9", None, time.time()))
            with suppress(OSError):  # it may not listen yet
                return b'machine="press-9"' in answered(own)[1]
            return False

        wait_for(is_known)
        for port in (site.port, own):
            plain, packed = answered(port), answered(port, accept_encoding="gzip")
            assert "content-encoding" not in plain[0]
            assert packed[0]["content-encoding"] == "gzip"
            assert packed[0]["content-type"] == plain[0]["content-type"]
            assert len(packed[1]) < len(plain[1]) / 2
            assert b'machine="press-9"' in gzip.decompress(packed[1])


@contextmanager
def prometheus(folder: Path, target: str) -> Iterator[Callable[..., Any]]:
    """A real one, with the rules that are shipped; yields what asks its API."""
    assert PROMETHEUS is not None
    shutil.copy(FILES / "prometheus-rules.yml", folder)
    own = (FILES / "prometheus.yml").read_text(encoding="utf-8").replace("15s", "1s").replace("127.0.0.1:8420", target)
    (folder / "prometheus.yml").write_text(re.sub(r"(?m)^alerting:\n(?: .*\n)+", "", own), encoding="utf-8")
    address = f"127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    command = [PROMETHEUS, f"--config.file={folder}/prometheus.yml", f"--storage.tsdb.path={folder}/data",
               f"--web.listen-address={address}"]  # fmt: skip
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as process:
        try:
            yield lambda path, **query: _asked(address, f"/api/v1/{path}", query)
        finally:
            process.kill()


def _asked(address: str, path: str, query: dict[str, str]) -> Any:
    connection = http.client.HTTPConnection(address, timeout=10.0)
    try:
        connection.request("GET", f"{path}?{urllib.parse.urlencode(query)}")
        return json.load(connection.getresponse())["data"]
    except (OSError, KeyError, ValueError) as error:  # it does not listen yet, or refuses the query
        return {"alerts": [], "result": [], "error": repr(error)}
    finally:
        connection.close()


@contextmanager
def at_act(place: str, folder: Path) -> Iterator[tuple[int, Callable[[], None]]]:
    """A site, or the outlet of a daemon: the port at which it is scraped, and what lets a machine report once more."""

    def report() -> ReportDocument:
        return report_of("press-9", None, time.time(), state=Level.ACT, events=(raised(),))

    if place == "site":
        with closing(Stranger("press-9")) as stranger, serving(folder, stranger.endpoint) as site:
            yield site.port, lambda: stranger.publish(report())
        return
    port = free_port(socket.SOCK_STREAM)
    table = OutletsTable.model_validate({"prometheus": {"listen": f"127.0.0.1:{port}"}})
    own = MachineOutlets(SITE, "press-9", folder / "machine.toml", table)
    with DaemonOutlets() as outlets:
        outlets.take(own.key, own)
        yield port, lambda: outlets.take(own.key, (0, report().to_json().encode()))


@pytest.mark.skipif(PROMETHEUS is None, reason="no prometheus: apt install prometheus")
@pytest.mark.parametrize("place", often(["site"], ["site", "daemon"]))
def test_a_real_prometheus_scrapes_it_and_its_alert_fires(place: str, tmp_path: Path) -> None:
    with at_act(place, tmp_path) as (port, report), prometheus(tmp_path, f"127.0.0.1:{port}") as ask:

        def firing() -> set[tuple[str, str]]:
            report()
            alerts = ask("alerts")["alerts"]
            return {(row["labels"]["alertname"], row["labels"]["machine"]) for row in alerts
                    if row["state"] == "firing"}  # fmt: skip

        wait_for(lambda: firing() == {("OtolithMachineAct", "press-9")})
        board = json.loads((FILES / "grafana-dashboard.json").read_text(encoding="utf-8"))
        for panel in board["panels"]:
            for target in panel["targets"]:
                expression = re.sub(r"\$(site|machine)", ".*", target["expr"]).replace("$parameter", "R_a")
                found = ask("query", query=expression)
                assert "error" not in found, expression
                is_new = "rate(" in expression or "latency" in expression
                assert is_new or found["result"] or "refused" in expression, expression
