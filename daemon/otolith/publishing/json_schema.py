"""JSON Schema of what daemons publish, from the models that write it; the comments of their fields are descriptions.

A document of a version gets further keys and further values of a choice, and loses none. So a schema closes no object,
and requires only what has been in each document of its version.
"""

import inspect
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue
from pydantic_core import core_schema

from otolith.health.schema import EventDocument, HealthDocument, NoticeDocument, ParameterDocument, ReportDocument
from otolith.publishing.commands.documents import CommandAnswerDocument, CommandDocument, SignedCommandDocument
from otolith.publishing.zenoh_session import (
    COMMAND,
    EVENT,
    PARAMETER,
    REPORT,
    START,
    HistoryQueryDocument,
    StartDocument,
    Topic,
)
from otolith_drivers.config_files import DocumentModel

DIALECT = "https://json-schema.org/draft/2020-12/schema"
_COMMENT = re.compile(r"^    (\w+): [^#\n]*#\s*([^\n]*)$", re.MULTILINE)
_DOCSTRING = re.compile(r'^    (\w+): [^\n]*\n    """([^"]*)"""$', re.MULTILINE)
_MARKUP = re.compile(r":\w+:`([^`]*)`|``([^`]*)``")


@dataclass(frozen=True, slots=True)
class PublishedDocument:
    """A kind of document, and where it is published."""

    model: type[DocumentModel]
    topic: Topic | None  # None of what is not published under a key of its own
    version: int = 1  # Another one once a key is gone or means something else
    place: str = "a part of the report"  # Without a topic

    def version_of(self, name: str) -> str:
        """Return kind and version, as a report has it at ``schema``."""
        return f"otolith.{name}/{self.version}"


DOCUMENTS: Mapping[str, PublishedDocument] = {
    "report": PublishedDocument(ReportDocument, REPORT),
    "event": PublishedDocument(EventDocument, EVENT),
    "parameter": PublishedDocument(ParameterDocument, PARAMETER),
    "health": PublishedDocument(HealthDocument, None),
    "start": PublishedDocument(StartDocument, START),
    "history-query": PublishedDocument(HistoryQueryDocument, None, place="parameters of a query of report and event"),
    "signed-command": PublishedDocument(SignedCommandDocument, None, place="payload of a query of command"),
    "command": PublishedDocument(CommandDocument, None, place="a part of signed-command"),
    "command-answer": PublishedDocument(CommandAnswerDocument, COMMAND),
    "notice": PublishedDocument(NoticeDocument, None, place="what the outlets of a site send"),
}


def schema_of(name: str) -> dict[str, Any]:
    """Return the schema of a kind of document."""
    own = DOCUMENTS[name]
    found = own.model.model_json_schema(mode="serialization", schema_generator=_Generator)
    return {"$schema": DIALECT, "$id": f"urn:otolith:{name}:{own.version}", **found, "title": own.version_of(name)}


class _Generator(GenerateJsonSchema):
    """Of what is written: keys without content are absent, never null."""

    def nullable_schema(self, schema: core_schema.NullableSchema) -> JsonSchemaValue:
        return self.generate_inner(schema["schema"])

    def default_schema(self, schema: core_schema.WithDefaultSchema) -> JsonSchemaValue:
        return self.generate_inner(schema["schema"])

    def model_schema(self, schema: core_schema.ModelSchema) -> JsonSchemaValue:
        own = super().model_schema(schema)
        own.pop("additionalProperties", None)
        own["description"] = _plain(own.get("description", ""))
        comments, properties = _comments(schema["cls"]), own.get("properties", {})
        for name, row in properties.items():
            row.pop("title", None)
            if name in comments:
                row["description"] = comments[name]
        own["properties"] = {name.rstrip("_"): row for name, row in properties.items()}
        if "schema" in own["properties"]:
            own["required"] = ["schema", *own["required"]]  # it has a default, and is always written
        return own

    def enum_schema(self, schema: core_schema.EnumSchema) -> JsonSchemaValue:
        own = super().enum_schema(schema)
        return {**own, "description": _plain(own.get("description", ""))}


def _comments(model: type[BaseModel]) -> dict[str, str]:
    """Return what the comments of the fields say, also of those that a model inherits."""
    sources = [inspect.getsource(each) for each in reversed(model.__mro__) if each.__module__.startswith("otolith")]
    rows = (row for source in sources for form in (_COMMENT, _DOCSTRING) for row in form.findall(source))
    names = {name: own.alias or name for name, own in model.model_fields.items()}
    return {names.get(name, name): _plain(" ".join(text.split())) for name, text in rows}


def _plain(text: str) -> str:
    """Return a text of the code without its markup; what is None there is absent in a document."""
    words = {"None": "absent", "True": "true", "False": "false"}
    plain = _MARKUP.sub(lambda found: found[1] or found[2], text)
    return re.sub(r"\b(None|True|False)\b", lambda found: words[found[0]], plain)
