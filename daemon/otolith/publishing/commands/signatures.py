"""Signatures of commands: a daemon knows who sent one, whichever routers it came through."""

import base64
import binascii
from collections.abc import Sequence
from datetime import datetime

from cryptography import x509
from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec, padding, rsa
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID
from pydantic import ValidationError

from otolith.publishing.certificates import Identity, check_identity, is_issued, private_key, utc_now
from otolith.publishing.commands.documents import MAX_COMMAND_BYTES, CommandDocument, SignedCommandDocument
from otolith_drivers.errors import ConfigurationError

PURPOSE = b"otolith.command/1\n"
"""Before what is signed, so that a signature of something else is none of a command."""


class CommandRefusedError(Exception):
    """A command is not carried out, and why."""


def signed(command: CommandDocument, identity: Identity) -> bytes:
    """Return a command with the signature of who sends it.

    Raises:
        ConfigurationError: a file cannot be used, or the certificate is not valid now.
    """
    certificate = check_identity(identity, ((), (), ()), (), utc_now())
    private, text = private_key(identity.key, ()), command.model_dump_json(by_alias=True)
    content = PURPOSE + text.encode()
    if isinstance(private, ec.EllipticCurvePrivateKey):
        signature = private.sign(content, ec.ECDSA(hashes.SHA256()))
    elif isinstance(private, rsa.RSAPrivateKey):
        signature = private.sign(content, padding.PKCS1v15(), hashes.SHA256())
    else:
        raise ConfigurationError(f"{identity.key}: commands are signed with a key of an elliptic curve or of RSA")
    pem = certificate.public_bytes(serialization.Encoding.PEM).decode()
    document = SignedCommandDocument(command=text, certificate=pem, signature=base64.b64encode(signature).decode())
    return document.model_dump_json().encode()


def verified(content: bytes, trusted: Sequence[x509.Certificate], now: datetime) -> tuple[CommandDocument, str]:
    """Return a command, and the name in the certificate of who sent it.

    The certificate must be issued by one of the ``trusted`` authorities itself, valid ``now``, and for clients.

    Raises:
        CommandRefusedError: it is no command, or not signed by such a certificate.
    """
    if len(content) > MAX_COMMAND_BYTES:
        raise CommandRefusedError(f"a command has at most {MAX_COMMAND_BYTES} bytes")
    try:
        document = SignedCommandDocument.model_validate_json(content)
        certificate = x509.load_pem_x509_certificate(document.certificate.encode())
        signature = base64.b64decode(document.signature, validate=True)
        names = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
        for_clients = _is_for_clients(certificate)
    except (ValueError, binascii.Error, UnsupportedAlgorithm, x509.DuplicateExtension) as error:
        raise CommandRefusedError("this is no signed command of a version that is known here") from error
    if len(names) != 1 or not for_clients or not any(is_issued(certificate, each) for each in trusted):
        raise CommandRefusedError("its certificate is not one of a client that the authority of this machine issued")
    if not certificate.not_valid_before_utc <= now <= certificate.not_valid_after_utc:
        raise CommandRefusedError("its certificate is not valid now: renew it, and check both clocks")
    try:
        _check(certificate, signature, PURPOSE + document.command.encode())
        command = CommandDocument.model_validate_json(document.command)
    except InvalidSignature as error:
        raise CommandRefusedError("its signature is not that of its certificate") from error
    except (ValidationError, UnicodeEncodeError) as error:
        raise CommandRefusedError("it is no command of a version that is known here") from error
    return command, str(names[0].value)


def _is_for_clients(certificate: x509.Certificate) -> bool:
    """Whether it may prove the name of a client: it says nothing of its purpose, or that."""
    try:
        usage = certificate.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
    except x509.ExtensionNotFound:
        return True
    return ExtendedKeyUsageOID.CLIENT_AUTH in usage


def _check(certificate: x509.Certificate, signature: bytes, content: bytes) -> None:
    """Raise InvalidSignature if a signature is not of this content, or of a key that is not known here."""
    public = certificate.public_key()
    if isinstance(public, ec.EllipticCurvePublicKey):
        public.verify(signature, content, ec.ECDSA(hashes.SHA256()))
    elif isinstance(public, rsa.RSAPublicKey):
        public.verify(signature, content, padding.PKCS1v15(), hashes.SHA256())
    else:
        raise InvalidSignature
