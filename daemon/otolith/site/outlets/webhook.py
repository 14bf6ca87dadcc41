"""A request to an address of HTTP for each notice. A redirection is not followed."""

import hashlib
import hmac
import http.client
import ssl
from collections import deque
from collections.abc import Sequence
from urllib.parse import urlsplit

from otolith import __version__
from otolith.outlet_tables import WebhookOutlet
from otolith.site.outlets.base import MachineView, Notice, OutletError, OutletSetup
from otolith.site.outlets.connections import failure, tls_context
from otolith_drivers.common.credentials import password
from otolith_drivers.grammars.json_lines import json_text

# Thresholds: docs/reference/thresholds-site.md has the origin of each.
ANSWER_TIMEOUT = 10.0  # s
MAX_ANSWER = 4096  # bytes of an answer that are read
REFUSED = (400, 404, 405, 410, 413, 415, 422)  # Statuses for which the same request is not sent again


class Webhook:
    """Implements :class:`otolith.site.outlets.base.Outlet`."""

    def __init__(self, options: WebhookOutlet, secret: bytes, tls: ssl.SSLContext | None) -> None:
        self._address, self._secret, self._tls = urlsplit(options.url), secret, tls
        self._path = self._address._replace(scheme="", netloc="", fragment="").geturl() or "/"

    def send(self, views: Sequence[MachineView], gone: Sequence[str], notices: deque[Notice]) -> bool:
        """Send each notice; see :class:`otolith.site.outlets.base.Outlet`."""
        refused: list[int] = []
        is_tried = bool(notices)
        while notices:
            try:
                status = self._post(notices[0])
            except OutletError as error:
                error.refused = len(refused)
                raise
            if not 200 <= status < 300:
                if status not in REFUSED:
                    raise OutletError(f"{self._address.hostname}: answers with status {status}", len(refused))
                refused.append(status)
            notices.popleft()
        if refused:
            reason = f"refuses notices with status {refused[-1]}: is url right?"
            raise OutletError(f"{self._address.hostname}: {reason}", len(refused))
        return is_tried

    def close(self) -> None:
        """Nothing is open."""

    def _post(self, notice: Notice) -> int:
        content = json_text(dict(notice.document())).encode(errors="replace")
        headers = {"content-type": "application/json", "user-agent": f"otolith/{__version__}",
                   "idempotency-key": hashlib.sha256(notice.key.encode(errors="replace")).hexdigest()}  # fmt: skip
        if self._secret:
            headers["x-otolith-signature"] = "sha256=" + hmac.new(self._secret, content, hashlib.sha256).hexdigest()
        try:
            connection = self._connection()
            try:
                connection.request("POST", self._path, content, headers)
                answer = connection.getresponse()
                answer.read(MAX_ANSWER)
                return answer.status
            finally:
                connection.close()
        except (OSError, http.client.HTTPException) as error:
            raise OutletError(failure(error, self._address.netloc)) from error

    def _connection(self) -> http.client.HTTPConnection:
        host, port = self._address.hostname or "", self._address.port
        if self._tls is not None:
            return http.client.HTTPSConnection(host, port, timeout=ANSWER_TIMEOUT, context=self._tls)
        return http.client.HTTPConnection(host, port, timeout=ANSWER_TIMEOUT)


def build(options: WebhookOutlet, setup: OutletSetup) -> Webhook:
    """Return the outlet; raise ConfigurationError if a file cannot be used."""
    secret = password(None if options.secret_file is None else setup.folder / options.secret_file, "secret_file")
    is_encrypted = urlsplit(options.url).scheme == "https"
    return Webhook(options, secret.encode(), tls_context(setup.folder, options.ca) if is_encrypted else None)
