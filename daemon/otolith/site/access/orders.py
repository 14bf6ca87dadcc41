"""Takes what named users send: checks who asks, from which page and how often, signs it, and tells what came of it."""

import hashlib
import hmac
import json
import logging
import secrets
import time
from collections import defaultdict, deque
from collections.abc import Callable
from dataclasses import astuple, dataclass, replace
from urllib.parse import parse_qsl

from otolith.publishing.certificates import Identity
from otolith.publishing.commands.documents import CommandAnswerDocument, CommandDocument, CommandKind
from otolith.publishing.commands.signatures import signed
from otolith.publishing.reader_sessions import NotCarriedOutError
from otolith.publishing.zenoh_session import COMMAND
from otolith.site.access.users import User
from otolith_drivers.errors import OtolithError

log = logging.getLogger(__name__)

# Thresholds: docs/reference/thresholds-site.md has the origin of each.
MAX_FORM = 4096  # bytes of what a browser sends
FORM_AGE = 600.0  # s for which a form can be sent
MAX_ORDERS = 20  # of a user in ...
ORDER_SPAN = 60.0  # ... s
MAX_GIVEN = 1000  # orders whose time is remembered
FIELDS = ("site", "machine", "event", "kind", "id", "at", "token")
Send = Callable[[str, bytes], bytes]
"""Sends a signed command to a key, and returns the answer; raises NotCarriedOutError."""


@dataclass(frozen=True, slots=True)
class Order:
    """What a form is about."""

    site: str
    machine: str
    event: str
    kind: str
    id: str
    at: str  # Unix s at which the form was made


@dataclass(frozen=True, slots=True)
class OrderOutcome:
    """What came of an order: the key of the words, the reason of a daemon, and the machine that it was about."""

    status: int
    word: str
    reason: str = ""
    machine: str = ""


REFUSED_USER = OrderOutcome(403, "order_user")


class Orders:
    """Of all users. It has no session and no cookie: a form holds only for the user and the command it was made for."""

    def __init__(
        self, users: tuple[str, ...], identity: Identity, send: Send,
        wall: Callable[[], float] = time.time, clock: Callable[[], float] = time.monotonic,
    ) -> None:  # fmt: skip
        """``users`` are names in certificates; ``identity`` is that of the site, which signs."""
        self._users, self._identity, self._send = frozenset(users), identity, send
        self._secret, self._wall, self._clock = secrets.token_bytes(32), wall, clock
        self._given: dict[str, float] = {}  # Time of each order, by its id: a second click is the same command
        self._done: defaultdict[str, deque[float]] = defaultdict(lambda: deque(maxlen=MAX_ORDERS))

    def may(self, user: User | None) -> bool:
        """Whether somebody may send commands."""
        return user is not None and user.name in self._users and self._wall() < user.until

    def fields(self, user: User, order: tuple[str, str, str, CommandKind]) -> dict[str, str]:
        """Return the hidden fields of the form of a user about site, machine, event and kind of a command."""
        own = Order(*order, secrets.token_hex(16), f"{self._wall():.0f}")
        return dict(zip(FIELDS, (*astuple(own), self._token(user.name, own)), strict=True))

    def give(self, user: User | None, content: bytes) -> OrderOutcome:
        """Send what a form says, and return what came of it."""
        if user is None or not self.may(user):
            return REFUSED_USER
        fields = _fields(content)
        token = fields.pop("token", "")
        try:
            order = Order(**fields)
        except TypeError:
            return OrderOutcome(400, "order_form")
        now, done = self._wall(), self._done[user.name]
        if not hmac.compare_digest(token.encode(), self._token(user.name, order).encode()):
            return OrderOutcome(403, "order_form")
        if not 0.0 <= now - float(order.at) + 1.0 <= FORM_AGE:
            return OrderOutcome(403, "order_form")
        if len(done) == MAX_ORDERS and self._clock() - done[0] < ORDER_SPAN:
            return OrderOutcome(429, "order_often")
        done.append(self._clock())
        return replace(self._sent(user.name, order, now), machine=f"{order.site}/{order.machine}")

    def _sent(self, name: str, order: Order, now: float) -> OrderOutcome:
        at = self._given.setdefault(order.id, now)
        while len(self._given) > MAX_GIVEN:
            del self._given[next(iter(self._given))]
        command = CommandDocument(
            id=order.id, site=order.site, machine=order.machine, kind=CommandKind(order.kind), event=order.event,
            by=name, at=at,
        )  # fmt: skip
        try:
            content = self._send(COMMAND.under(order.site, order.machine), signed(command, self._identity))
            answer = CommandAnswerDocument.model_validate_json(content)
        except NotCarriedOutError as error:
            return (
                OrderOutcome(409, "order_refused", str(error)) if str(error) else OrderOutcome(502, "order_unanswered")
            )
        except ValueError:  # no daemon has written it
            return OrderOutcome(502, "order_unanswered")
        except OtolithError as error:
            log.warning("a command is not signed: %s", error)
            return OrderOutcome(502, "order_unsigned")
        log.info("%s sent %s %s to %s/%s", name, order.kind, order.event, order.site, order.machine)
        return OrderOutcome(200, "order_done" if answer.is_new else "order_again")

    def _token(self, name: str, order: Order) -> str:
        content = json.dumps([name, *astuple(order)]).encode()
        return hmac.new(self._secret, content, hashlib.sha256).hexdigest()


def _fields(content: bytes) -> dict[str, str]:
    """Return the fields of a form that are known here; none of one that is written otherwise."""
    try:
        pairs = parse_qsl(content.decode("ascii"), strict_parsing=True, max_num_fields=2 * len(FIELDS), errors="strict")
    except ValueError:
        return {}
    return {name: value for name, value in pairs if name in FIELDS}
