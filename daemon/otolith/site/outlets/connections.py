"""What outlets over a network share: TLS by the files of a table, and the cause of a failure in words."""

import ssl
from pathlib import Path

from otolith_drivers.common.credentials import certificate_and_key
from otolith_drivers.common.reconnection import cause_of
from otolith_drivers.errors import ConfigurationError


def tls_context(folder: Path, ca: Path | None, pair: tuple[Path | None, Path | None] = (None, None)) -> ssl.SSLContext:
    """Return a context that checks the other side by ``ca``, by default by the authorities of the computer.

    Raises:
        ConfigurationError: a file cannot be used.
    """
    key = "ca"
    try:
        context = ssl.create_default_context(cafile=None if ca is None else folder / ca)
        if pair[0] is not None and pair[1] is not None:
            key, files = "certificate", (folder / pair[0], folder / pair[1])
            certificate_and_key(*files)
            context.load_cert_chain(*files, password=lambda: b"")
    except (OSError, ValueError) as error:
        raise ConfigurationError(f"is not in PEM, or not usable: {cause_of(error)}", ("driver", key)) from error
    return context


def failure(error: Exception, what: str) -> str:
    """Return why a connection failed."""
    if isinstance(error, ssl.SSLCertVerificationError):
        return f"{what}: its certificate is refused: {error.verify_message}: are ca, host and the clock here right?"
    if isinstance(error, TimeoutError) and not error.errno:
        return f"{what}: no answer in time: is it there, and is tls right?"
    return f"{what}: {cause_of(error)}"
