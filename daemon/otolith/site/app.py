"""The site over HTTP: pages, live events, metrics. It answers reading requests to its own names, and no others."""

import asyncio
import re
import time
from collections.abc import Awaitable, Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from importlib.resources import files
from typing import Any
from urllib.parse import urlencode, urlsplit

from starlette.applications import Starlette
from starlette.requests import ClientDisconnect, Request
from starlette.responses import HTMLResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from otolith.health.schema import LANGUAGES, Language
from otolith.health.text import report_in, texts_in
from otolith.health.times import moment_text
from otolith.site.access.offers import offers_of
from otolith.site.access.orders import MAX_FORM, REFUSED_USER, OrderOutcome, Orders
from otolith.site.access.users import User
from otolith.site.collector import Collector
from otolith.site.compare import peers, poor_data, week
from otolith.site.daemons import certificates, own_certificate, versions
from otolith.site.hall import PAGES, Filter, Hall, Shown
from otolith.site.known import KnownMachine
from otolith.site.outlets.base import OutletStatus
from otolith.site.past import FIRST_SPAN, SPANS
from otolith.site.serving.live import Live, Places
from otolith.site.serving.pace import Fresh, Turns
from otolith.site.serving.past_pages import PastPages
from otolith.site.serving.pieces import Pieces
from otolith.site.serving.scrapes import Scrapes
from otolith.site.settings import OWN_HOSTS, SiteFile
from otolith.site.words import accepted, words_in
from otolith_drivers.outside_text import visible

# Thresholds: docs/reference/thresholds-site.md has the origin of each.
MAX_AGE = 0.5  # s of the hall and of the health that are given to several who ask
MAX_COMPARISON_AGE = 5.0  # s of a comparison
REFRESH = 30  # s after which a browser asks for the page of a machine again
BUSY_REFRESH = 5  # s after which it asks again if many look at the past
MAX_QUERY = 512  # characters of the query of an address
FORM_TIME = 10.0  # s for a browser to send a form
MAX_SENDING = 4  # commands that are sent at a time
MAX_REASON = 500  # characters of why a daemon refuses a command
COMMAND = "/command"
FIRST_PEERS = 8  # machines of a parameter that are seen at once, with those that differ
HOST = re.compile(r"(?:\[([0-9a-f:.]+)\]|([^\s:@/?#\[\]\\]+))(?::\d{1,5})?")
HTML = "text/html"
Show = Callable[[Request], Awaitable[Response]]
STATIC = {"site.css": "text/css", "site.js": "text/javascript"}
HEADERS = {
    "content-security-policy": "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
    "img-src data:; form-action 'self'; base-uri 'none'; frame-ancestors 'none'",
    "x-content-type-options": "nosniff",
    "referrer-policy": "same-origin",  # without one, a browser would not say which page sends a form
    "cross-origin-resource-policy": "same-origin",
    "cross-origin-opener-policy": "same-origin",
    "cache-control": "no-store",
}

OWN_POLICY = "content-security-policy"
REPORT_POLICY = (
    "default-src 'none'; style-src 'unsafe-inline'; img-src data:; base-uri 'none'; frame-ancestors 'none'; "
    "form-action 'self'"
)
"""Of a report page: it places its curves and lanes by styles of their elements, and has no script at all."""


READ_ONLY = 405, "the site is read only"


class Guard:
    """Refuses what is not for the site: other names, other origins, writing methods, long queries.

    If it ``takes_commands``, these are sent by the pages of the site itself, and by no others.
    """

    def __init__(self, app: ASGIApp, hosts: tuple[str, ...], *, takes_commands: bool = False) -> None:
        self._app, self._hosts = app, frozenset(host.lower() for host in (*OWN_HOSTS, *hosts))
        self._takes_commands = takes_commands

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer, or refuse."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        if scope["type"] != "http":
            return

        async def send_guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                given = list(message.get("headers", ()))
                names = {name for name, _ in given}
                own = [(name.encode(), value.encode()) for name, value in HEADERS.items() if name.encode() not in names]
                message = {**message, "headers": [*given, *own]}
            await send(message)

        refusal = self._refusal(scope)
        answer = self._app
        if refusal is not None:  # what may follow in the connection is not read
            answer = PlainTextResponse(refusal[1] + "\n", refusal[0], {"connection": "close"})
        await answer(scope, receive, send_guarded)

    def _refusal(self, scope: Scope) -> tuple[int, str] | None:
        headers = [(name, value.decode("latin-1")) for name, value in scope["headers"]]
        hosts = [value for name, value in headers if name == b"host"]
        names = {name for name, _ in headers}
        is_command = scope["method"] == "POST" and self._takes_commands and scope["path"] == COMMAND
        if b"transfer-encoding" in names:
            return 501, "the length of a request is stated by content-length"
        if not is_command and any(value != "0" for name, value in headers if name == b"content-length"):
            return (400, "a request for a page has no content") if scope["method"] in ("GET", "HEAD") else READ_ONLY
        if len(hosts) != 1 or host_named(hosts[0]) not in self._hosts:
            return 421, "this site has another name: http.hosts of its file lists the names that it answers to"
        origins = [value for name, value in headers if name == b"origin"]
        if is_command:
            sites = {value for name, value in headers if name == b"sec-fetch-site"}
            if origins != [f"{scope['scheme']}://{hosts[0].lower()}"] or sites - {"same-origin"}:
                return 403, "a command is sent by a page of this site only"
        elif scope["method"] not in ("GET", "HEAD"):
            return READ_ONLY
        elif any(_place(origin) != hosts[0].lower() for origin in origins):
            return 403, "this request comes from the page of another site"
        if len(scope["query_string"]) > MAX_QUERY:
            return 414, f"the query has more than {MAX_QUERY} characters"
        return None


def _place(origin: str) -> str:
    """Return host and port of an ``Origin`` header; empty if it is no address."""
    try:
        return urlsplit(origin).netloc.lower()
    except ValueError:
        return ""


def host_named(header: str) -> str:
    """Return the host of a ``Host`` header without its port; empty if it is neither a name nor an address."""
    match = HOST.fullmatch(header.lower())
    return "" if match is None else match[1] or match[2]


class SitePages:
    """The handlers of all addresses. The loop takes no lock: what needs it is made in other threads."""

    def __init__(
        self, collector: Collector, settings: SiteFile, outlets: Sequence[OutletStatus] = (),
        orders: Orders | None = None,
    ) -> None:  # fmt: skip
        """Without ``orders`` nobody may send commands."""
        self._collector, self._settings, self._outlets, self._orders = collector, settings, outlets, orders
        self._sending = ThreadPoolExecutor(MAX_SENDING, "send-command")
        self._hall = Hall(collector.knowledge, settings.timezone)
        self._live, self._turns = Places(), Turns()
        self._past = PastPages(collector, settings.timezone)
        pages, scrapes = (ThreadPoolExecutor(1, f"make-{name}") for name in ("pages", "metrics"))
        self._halls = {each: Fresh(partial(self._shown, each), MAX_AGE, pages) for each in LANGUAGES}
        self._comparisons = {
            each: Fresh(partial(self._compared, each), MAX_COMPARISON_AGE, pages) for each in LANGUAGES
        }
        self._scrapes = Scrapes(collector, self._outlets, scrapes)
        self._health = Fresh(self._status, MAX_AGE, scrapes)
        self._started = time.time()

    def app(self) -> ASGIApp:
        """Return the application."""
        pages = {"/": self._show_hall, "/compare": self._show_comparison, "/live": self._show_live,
                 "/machine/{site}/{machine}": self._show_machine}  # fmt: skip
        routes = [
            Route("/metrics", self._scrapes.answer), Route("/healthz", self._show_health),
            *(Route(path, self._in_turn(show)) for path, show in pages.items()),
            *(Route(f"/{name}", self._in_turn(_static(name, kind))) for name, kind in STATIC.items()),
            Route(COMMAND, self._in_turn(self._take_order), methods=["POST"]),
        ]  # fmt: skip
        handlers: Mapping[Any, Callable[[Request, Exception], Awaitable[Response]]] = {404: self._show_nothing}
        whole = Starlette(routes=routes, exception_handlers=dict(handlers))
        return Guard(whole, self._settings.http.hosts, takes_commands=self._orders is not None)

    def _in_turn(self, show: Show) -> Show:
        async def shown(request: Request) -> Response:
            await self._turns.take()
            return await show(request)

        return shown

    def _language(self, request: Request) -> Language:
        asked = request.query_params.get("language")
        own = next((language for language in LANGUAGES if language == asked), None)
        return own or self._settings.language or accepted(request.headers.get("accept-language", ""))

    def _frame(self, language: Language) -> dict[str, Any]:
        """Return what every page needs."""
        return {
            "words": words_in(language), "title": self._settings.title,
            "time": moment_text(time.time(), self._settings.timezone), "dropped": self._collector.dropped.total(),
        }  # fmt: skip

    def _shown(self, language: Language) -> Shown:
        with self._collector.lock:
            return self._hall.shown(time.monotonic(), language)

    async def _show_hall(self, request: Request) -> Response:
        language, chosen = self._language(request), _filter(request)
        query = {"area": chosen.area, "state": chosen.state, "name": chosen.name, "language": language}
        own = f"?{urlencode({key: value for key, value in query.items() if value})}"
        hall = await self._halls[language].get()
        return Pieces(hall.page(chosen, own, self._frame(language)), HTML)

    def _compared(self, language: Language) -> list[bytes]:
        knowledge, zone, now = self._collector.knowledge, self._settings.timezone, time.monotonic()
        validity, today = own_certificate(self._collector.certificate), time.time()
        with self._collector.lock:
            own = {"peers": peers(knowledge, now, language), "poor": poor_data(knowledge, now, language, zone),
                   "events": week(knowledge, today, language, zone), "versions": versions(knowledge, language),
                   "certificates": certificates(knowledge, today, language, zone, validity)}  # fmt: skip
            refused = {reason.value: count for reason, count in knowledge.refused.items()}
        page = PAGES.get_template("compare.html").render(
            own, first=FIRST_PEERS, here="compare", language=language, refused=refused, **self._frame(language)
        )
        return [page.encode(errors="replace")]

    async def _show_comparison(self, request: Request) -> Response:
        return Pieces(await self._comparisons[self._language(request)].get(), HTML)

    async def _show_machine(self, request: Request) -> Response:
        """Show what 'otolith report' shows, of a time for which the daemon is asked."""
        language, asked = self._language(request), request.query_params.get("time", "")
        site, name = request.path_params["site"], request.path_params["machine"]
        known = self._collector.knowledge.get(site, name)
        if known is None:
            return await self._show_nothing(request, Exception())
        span = asked if asked in SPANS else FIRST_SPAN
        try:
            page = await self._past.get((site, name, span, language), known.report, _address(request))
        except (ValueError, LookupError, ArithmeticError, OSError):  # anybody may have published it
            return await self._message(language, "unreadable", 502)
        if page is None:
            return await self._message(language, "busy", 503, {"refresh": f"{BUSY_REFRESH}"})
        nav = PAGES.get_template("spans.html").render(
            site=site, machine=name, spans=SPANS, span=span, past=page.past, language=language, **self._frame(language)
        )
        headers = {OWN_POLICY: REPORT_POLICY, "refresh": f"{REFRESH}"}
        own = self._commands(request, known, language)
        parts = [page.head, nav.encode(errors="replace"), page.top, own.encode(errors="replace"), page.rest]
        return Pieces(parts, HTML, headers=headers)

    def _commands(self, request: Request, machine: KnownMachine, language: Language) -> str:
        """Return what can be commanded about a machine: lines to read out, and buttons for a user who may send them."""
        offered = [] if machine.report is None else offers_of(report_in(machine.report, language))
        user, fields = _user(request), None
        if self._orders is not None and user is not None and self._orders.may(user):
            fields = partial(self._orders.fields, user)
        own = {"site": machine.site, "machine": machine.name, "offered": offered, "fields": fields, "user": user}
        return PAGES.get_template("commands.html").render(
            own, path=COMMAND, texts=texts_in(language), language=language, words=words_in(language)
        )

    async def _take_order(self, request: Request) -> Response:
        """Send the command of a form, and say what came of it."""
        language, user = self._language(request), _user(request)
        if self._orders is None or user is None or not self._orders.may(user):
            return self._told(REFUSED_USER, language)
        if (content := await _form(request)) is None:
            return await self._message(language, "order_form", 400)
        loop = asyncio.get_running_loop()
        return self._told(await loop.run_in_executor(self._sending, self._orders.give, user, content), language)

    def _told(self, outcome: OrderOutcome, language: Language) -> Response:
        text = words_in(language)[outcome.word].format(reason=visible(outcome.reason, MAX_REASON))
        page = PAGES.get_template("message.html").render(
            text=text, here="order", machine=outcome.machine, language=language, refused={}, **self._frame(language)
        )
        return HTMLResponse(page, outcome.status)

    async def _show_nothing(self, request: Request, _: Exception) -> Response:
        await self._turns.take()
        return await self._message(self._language(request), "not_found", 404)

    async def _message(
        self, language: Language, word: str, status: int, headers: Mapping[str, str] | None = None
    ) -> Response:
        own = {"text": words_in(language)[word], "here": "", "language": language, "refused": {}}
        page = PAGES.get_template("message.html").render(own, **self._frame(language))
        return HTMLResponse(page, status, headers)

    def _status(self) -> tuple[bool, dict[str, Any]]:
        is_connected = self._collector.connected
        return is_connected, {
            "status": "ok" if is_connected else "no daemon and no router is connected",
            "machines": len(self._collector.knowledge), "since": round(self._started, 1),
            "outlets": {each.name: each.reason or "ok" for each in self._outlets},
        }  # fmt: skip

    async def _show_health(self, _: Request) -> Response:
        is_connected, status = await self._health.get()
        return JSONResponse(status, 200 if is_connected else 503)

    async def _show_live(self, request: Request) -> Response:
        return Live(self._halls[self._language(request)].get, _filter(request), self._live, self._collector.hindered)


def _address(request: Request) -> str:
    """Return who asks."""
    return request.client.host if request.client else ""


def _user(request: Request) -> User | None:
    user = getattr(request.state, "user", None)
    return user if isinstance(user, User) else None


async def _form(request: Request) -> bytes | None:
    """Return what a browser sends; None of too much, or if it comes too slowly."""
    content = bytearray()
    try:
        async with asyncio.timeout(FORM_TIME):
            async for part in request.stream():
                content += part
                if len(content) > MAX_FORM:
                    return None
    except (TimeoutError, ClientDisconnect):
        return None
    return bytes(content)


def _filter(request: Request) -> Filter:
    query = request.query_params
    return Filter(*(query.get(key, "")[:64] for key in ("area", "state", "name")))


def _static(name: str, kind: str) -> Callable[[Request], Awaitable[Response]]:
    content = files("otolith.site").joinpath("pages", name).read_bytes()

    async def show(_: Request) -> Response:
        return Response(content, media_type=kind)

    return show
