"""The schemas hold for what was published, by each version, and refuse what no daemon publishes; the docs have them."""

import json
from pathlib import Path
from typing import Any

import pytest
import zenoh
from jsonschema import Draft202012Validator, ValidationError

from otolith.health.limits import Level
from otolith.health.schema import EventChange, EventDocument, NoteDocument, ReportDocument
from otolith.publishing.certificates import Identity, make_authority, make_certificate, utc_now
from otolith.publishing.commands.documents import CommandAnswerDocument
from otolith.publishing.commands.signatures import signed
from otolith.publishing.json_schema import DOCUMENTS, schema_of
from otolith.publishing.zenoh_session import StartDocument, selection
from otolith.site.outlets.base import Notice, Told
from otolith.storage.history import HistoryReader
from tests.cli.commands import otolith
from tests.publishing.test_commands import command
from tests.sites.machines import raised, report_of
from tests.storage.histories import MACHINE, SITE, START, document

ROOT = Path(__file__).parents[2]
HISTORIES = sorted((ROOT / "tests" / "golden" / "histories").glob("*.sqlite"))


def checked(name: str, text: str) -> Any:
    """A document, which is as its schema says."""
    content = json.loads(text)
    Draft202012Validator(schema_of(name)).validate(content)
    return content


@pytest.mark.parametrize("name", DOCUMENTS)
def test_the_schema_is_one_and_the_docs_and_the_command_have_it(name: str) -> None:
    schema = schema_of(name)
    Draft202012Validator.check_schema(schema)
    assert schema["$id"].endswith(f":{name}:{DOCUMENTS[name].version}")
    printed = otolith("schema", name)
    assert json.loads(printed.stdout) == schema
    shipped = (ROOT / "docs" / "reference" / "schemas" / f"{name}.json").read_text(encoding="utf-8")
    assert shipped == printed.stdout, f"make schemas writes {name}.json"
    assert name in otolith("schema").stdout


def test_all_that_is_published_is_as_its_schema_says() -> None:
    note = NoteDocument(by="anna", at=START, text="seen")
    event = raised().model_copy(update={"acknowledged": note, "comments": (note,), "change": EventChange.RAISED})
    report = report_of(state=Level.ACT, events=(event,))
    content = checked("report", report.to_json())
    assert content["schema"] == DOCUMENTS["report"].version_of("report")
    checked("report", document(51, START, None).to_json())
    checked("event", event.json_line())
    for row in report.parameters.values():
        checked("parameter", row.json_line())
    assert report.health is not None
    checked("health", report.health.json_line())
    checked("start", StartDocument(site="a", machine="b", done=1, total=2, text="1 of 2").json_line())
    for told in Told:
        checked("notice", json.dumps(Notice(SITE, MACHINE, told, event).document()))


def test_a_command_is_as_its_schema_says(tmp_path: Path) -> None:
    make_authority(tmp_path, utc_now())
    make_certificate(tmp_path, "site", [], utc_now())
    own = Identity(tmp_path / "ca.crt", tmp_path / "site.crt", tmp_path / "site.key")
    checked("command", checked("signed-command", signed(command(), own).decode())["command"])
    checked("command-answer", CommandAnswerDocument(id="0" * 32, is_new=True).json_line())


@pytest.mark.parametrize(
    "parameters",
    ["_time=[now(-1h)..now()];limit=1", "_time=]2026-01-31T06:00:00Z..[", "after=12", "last=500", "limit=3", "",
     "_time=now()", "after=-1", "last=x", "after=1;limit=1e3", "_time=[a]..[b]"],
)  # fmt: skip
def test_the_schema_of_a_query_refuses_what_a_daemon_refuses(parameters: str) -> None:
    given = dict(pair.split("=", 1) for pair in parameters.split(";") if pair)
    is_valid = Draft202012Validator(schema_of("history-query")).is_valid(given)
    try:
        selection(zenoh.Parameters(parameters), START)
    except ValueError:
        assert not is_valid
    else:
        assert is_valid


@pytest.mark.parametrize("path", HISTORIES, ids=lambda path: path.name)
def test_what_earlier_versions_published_is_still_as_the_schema_says(path: Path) -> None:
    reader = HistoryReader.of_file(path)
    texts = {kind: reader.messages(kind, 100) for kind in ("report", "event")}
    assert all(texts.values())
    for kind, own in texts.items():
        for text in own:
            checked(kind, text)


@pytest.mark.parametrize(
    ("key", "value"),
    [("machine", None), ("machine", 3), ("schema", "otolith.report/2"), ("parameters", []), ("events", [{}])],
)
def test_the_schema_refuses_what_is_no_report(key: str, value: object) -> None:
    content = json.loads(report_of().to_json()) | {key: value}
    if value is None:
        del content[key]
    with pytest.raises(ValidationError):
        Draft202012Validator(schema_of("report")).validate(content)


def test_a_document_of_a_later_version_may_have_more() -> None:
    content = json.loads(report_of().to_json()) | {"new": 1}
    Draft202012Validator(schema_of("report")).validate(content)


def test_the_keys_of_the_schema_are_those_of_the_documents() -> None:
    for name, model in (("report", ReportDocument), ("event", EventDocument)):
        names = {key.rstrip("_") for key in model.model_fields}
        assert set(schema_of(name)["properties"]) == names


def test_the_schema_says_what_a_value_is_in() -> None:
    event = schema_of("event")["properties"]
    assert "Unix seconds" in event["start"]["description"]
    assert "null" not in json.dumps(schema_of("report"))
