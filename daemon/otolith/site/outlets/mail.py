"""An e-mail with what happened at a moment: one for all notices that wait."""

import smtplib
import ssl
from collections import deque
from collections.abc import Sequence
from email.message import EmailMessage
from email.utils import formatdate, make_msgid

from otolith.health.text import texts_in
from otolith.health.times import in_local_time, moment_text
from otolith.outlet_tables import MailOutlet
from otolith.site.outlets.base import MachineView, Notice, OutletError, OutletSetup, Told
from otolith.site.outlets.connections import failure, tls_context
from otolith.site.words import words_in
from otolith_drivers.common.credentials import password
from otolith_drivers.outside_text import visible

# Thresholds: docs/reference/thresholds-site.md has the origin of each.
ANSWER_TIMEOUT = 10.0  # s
MAX_TOGETHER = 50  # notices in one e-mail
MAX_SUBJECT = 120  # characters
MAX_LINE = 1000  # characters of a text
LASTING = 500  # Statuses of SMTP from which the same e-mail is not sent again


class Mail:
    """Implements :class:`otolith.site.outlets.base.Outlet`."""

    def __init__(self, options: MailOutlet, secret: str, tls: ssl.SSLContext, setup: OutletSetup) -> None:
        self._options, self._secret, self._tls, self._setup = options, secret, tls, setup

    def send(self, views: Sequence[MachineView], gone: Sequence[str], notices: deque[Notice]) -> bool:
        """Send the notices together; see :class:`otolith.site.outlets.base.Outlet`."""
        is_tried = bool(notices)
        while notices:
            own = list(notices)[:MAX_TOGETHER]
            try:
                self._send(self._message(own))
            except (OSError, smtplib.SMTPException) as error:
                is_lasting = _is_lasting(error)
                if is_lasting:
                    _remove(notices, len(own))
                raise OutletError(failure(error, self._options.host), len(own) if is_lasting else 0) from error
            _remove(notices, len(own))
        return is_tried

    def close(self) -> None:
        """Nothing is open."""

    def _message(self, notices: Sequence[Notice]) -> EmailMessage:
        lines = [line for notice in notices for line in (*self._lines(notice), "")]
        first = notices[0]
        more = f" (+{len(notices) - 1})" if len(notices) > 1 else ""
        subject = f"{self._setup.title}: {self._title(first)}{more}"
        message = EmailMessage()
        message["Subject"] = visible(subject)[:MAX_SUBJECT]
        message["From"], message["To"] = self._options.sender, ", ".join(self._options.to)
        message["Date"], message["Auto-Submitted"] = formatdate(localtime=False), "auto-generated"
        message["Message-ID"] = make_msgid("otolith", self._options.sender.rpartition("@")[2])
        message.set_content("\n".join(lines))
        return message

    def _title(self, notice: Notice) -> str:
        texts, event = texts_in(notice.event.language), notice.event
        word = texts.translated("OK" if notice.told is Told.CLEARED else event.state)
        return f"{word} {notice.machine}: {texts.part(event.part)}: {event.condition}"

    def _lines(self, notice: Notice) -> Sequence[str]:
        words, event = words_in(notice.event.language), notice.event
        at = moment_text(event.since if event.end is None else event.end, event.timezone)
        what = f"{words['what_to_do']}: {event.advice}"
        is_open = notice.told is not Told.CLEARED and event.advice
        text = texts_in(event.language).decimals(in_local_time(event.text, event.timezone))
        own = (self._title(notice), f"{notice.site}, {at}", text, *((what,) if is_open else ()))
        return [_short(visible(line)) for line in own]

    def _send(self, message: EmailMessage) -> None:
        options = self._options
        if options.security == "tls":
            client: smtplib.SMTP = smtplib.SMTP_SSL(
                options.host, options.port, timeout=ANSWER_TIMEOUT, context=self._tls
            )
        else:
            client = smtplib.SMTP(options.host, options.port, timeout=ANSWER_TIMEOUT)
        with client:
            if options.security == "starttls":
                client.starttls(context=self._tls)
            if options.user is not None:
                client.login(options.user, self._secret)
            client.send_message(message)


def _short(line: str) -> str:
    return line if len(line) <= MAX_LINE else f"{line[: MAX_LINE - 1]}…"


def _remove(notices: deque[Notice], count: int) -> None:
    for _ in range(count):
        notices.popleft()


def _is_lasting(error: Exception) -> bool:
    """Whether the server will not take this e-mail later either; a wrong password is mended by a person."""
    if isinstance(error, smtplib.SMTPRecipientsRefused):
        return all(code >= LASTING for code, _ in error.recipients.values())
    is_answer = isinstance(error, smtplib.SMTPDataError | smtplib.SMTPSenderRefused)
    return is_answer and getattr(error, "smtp_code", 0) >= LASTING


def build(options: MailOutlet, setup: OutletSetup) -> Mail:
    """Return the outlet; raise ConfigurationError if a file cannot be used."""
    secret = password(None if options.password_file is None else setup.folder / options.password_file)
    return Mail(options, secret, tls_context(setup.folder, options.ca), setup)
