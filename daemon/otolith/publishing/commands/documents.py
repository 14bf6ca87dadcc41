"""What is sent to a daemon, and what it answers: a command, its signature, and that it was carried out."""

from enum import StrEnum
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, StringConstraints

from otolith_drivers.config_files import DocumentModel, check_name

# Thresholds: docs/reference/thresholds-runtime.md has the origin of each.
MAX_USER = 60  # characters of the name of a person
MAX_COMMAND_BYTES = 16 << 10  # of a signed command
Name = Annotated[str, AfterValidator(check_name)]


class CommandKind(StrEnum):
    """What a person decides about an event."""

    ACKNOWLEDGE = "acknowledge"  # It was seen
    APPROVE = "approve"  # The component that it is about belongs to the healthy machine
    REJECT = "reject"  # The component that it is about does not exist


class CommandDocument(DocumentModel):
    """What a person commands one daemon to do with one event, once."""

    schema_: Literal["otolith.command/1"] = Field(default="otolith.command/1", alias="schema")
    id: Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{32}$")]  # Chosen at random: each is carried out once
    site: Name  # Of the machine
    machine: Name
    kind: CommandKind
    event: Annotated[str, StringConstraints(min_length=1, max_length=256)]  # Id of an open event
    by: Annotated[str, StringConstraints(min_length=1, max_length=MAX_USER)]  # Who commands it
    at: float  # Unix seconds at which it was given


class SignedCommandDocument(DocumentModel):
    """A command as it is sent: the payload of a query for ``command``. Text and signature are byte for byte the same.

    The signature is of SHA-256 of ``otolith.command/1``, a line feed and the text, by ECDSA or RSA (PKCS #1 v1.5).
    """

    command: str  # The command, a JSON text
    certificate: str  # Of who sends it, in PEM
    signature: str  # In base64


class CommandAnswerDocument(DocumentModel):
    """What a daemon answers to a command that it has carried out; otherwise its answer is an error with the reason."""

    id: str  # Of the command
    is_new: bool  # False if it had been carried out before
