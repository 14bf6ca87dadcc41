"""The site over HTTP: pages, live events, metrics. It answers reading requests to its own names, and no others."""

import asyncio
import json
import time
from collections.abc import Awaitable, Callable, Mapping, Sequence
from functools import partial
from importlib.resources import files
from typing import Any
from urllib.parse import urlencode, urlsplit

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import HTMLResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from otolith.health.schema import LANGUAGES, Language
from otolith.health.times import moment_text
from otolith.publishing.received_history import received_page
from otolith.site.collector import Collector
from otolith.site.compare import peers, poor_data, week
from otolith.site.hall import PAGES, Filter, Hall
from otolith.site.metrics import CONTENT_TYPE, exposition
from otolith.site.outlets.runner import OutletStatus
from otolith.site.past import SPANS, PastQuery, past_of
from otolith.site.settings import OWN_HOSTS, SiteFile
from otolith.site.words import accepted, words_in

# Thresholds: docs/reference/thresholds-site.md has the origin of each.
MAX_LIVE = 64  # browsers that get live events at a time
TICK = 1.0  # s between two looks for what has changed
SEND_TIMEOUT = 10.0  # s that a slow reader may take for one event
REFRESH = 30  # s after which a browser asks for the page of a machine again
MAX_LOOKING = 4  # pages of the past of machines that are made at a time
MAX_QUERY = 512  # characters of the query of an address
FIRST_PEERS = 8  # machines of a parameter that are seen at once, with those that differ
STATIC = {"site.css": "text/css", "site.js": "text/javascript"}
HEADERS = {
    "content-security-policy": "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
    "img-src data:; form-action 'self'; base-uri 'none'; frame-ancestors 'none'",
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cross-origin-resource-policy": "same-origin",
    "cross-origin-opener-policy": "same-origin",
    "cache-control": "no-store",
}

OWN_POLICY = "content-security-policy"
REPORT_POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; base-uri 'none'; frame-ancestors 'none'"
"""Of a report page: it places its curves and lanes by styles of their elements, and has no script at all."""


class Guard:
    """Refuses what is not for the site: other names, other origins, writing methods, long queries."""

    def __init__(self, app: ASGIApp, hosts: tuple[str, ...]) -> None:
        self._app, self._hosts = app, frozenset(host.lower() for host in (*OWN_HOSTS, *hosts))

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
        answer = self._app if refusal is None else PlainTextResponse(refusal[1] + "\n", refusal[0])
        await answer(scope, receive, send_guarded)

    def _refusal(self, scope: Scope) -> tuple[int, str] | None:
        headers = [(name, value.decode("latin-1")) for name, value in scope["headers"]]
        hosts = [value for name, value in headers if name == b"host"]
        if len(hosts) != 1 or host_named(hosts[0]) not in self._hosts:
            return 421, "this site has another name: http.hosts of its file lists the names that it answers to"
        if scope["method"] not in ("GET", "HEAD"):
            return 405, "the site is read only"
        for origin in (value for name, value in headers if name == b"origin"):
            if _place(origin) != hosts[0].lower():
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
    """Return the host of a ``Host`` header without its port."""
    try:
        return (urlsplit(f"//{header}").hostname or "").lower()
    except ValueError:
        return ""


class SitePages:
    """The handlers of all addresses."""

    def __init__(self, collector: Collector, settings: SiteFile, outlets: Sequence[OutletStatus] = ()) -> None:
        self._collector, self._settings, self._outlets = collector, settings, outlets
        self._hall = Hall(collector.knowledge, settings.timezone)
        self._live = asyncio.Semaphore(MAX_LIVE)
        self._looking = asyncio.Semaphore(MAX_LOOKING)
        self._started = time.time()

    def app(self) -> ASGIApp:
        """Return the application."""
        routes = [
            Route("/", self._show_hall), Route("/compare", self._show_comparison),
            Route("/live", self._show_live), Route("/metrics", self._show_metrics),
            Route("/healthz", self._show_health), Route("/machine/{site}/{machine}", self._show_machine),
            *(Route(f"/{name}", _static(name, kind)) for name, kind in STATIC.items()),
        ]  # fmt: skip
        handlers: Mapping[Any, Callable[[Request, Exception], Awaitable[Response]]] = {404: self._show_nothing}
        return Guard(Starlette(routes=routes, exception_handlers=dict(handlers)), self._settings.http.hosts)

    def _language(self, request: Request) -> Language:
        asked = request.query_params.get("language")
        own = next((language for language in LANGUAGES if language == asked), None)
        return own or self._settings.language or accepted(request.headers.get("accept-language", ""))

    def _frame(self, language: Language, here: str = "") -> dict[str, Any]:
        """Return what every page needs."""
        knowledge, dropped = self._collector.knowledge, self._collector.dropped
        return {
            "language": language, "words": words_in(language), "title": self._settings.title, "here": here,
            "time": moment_text(time.time(), self._settings.timezone), "dropped": dropped.total(),
            "refused": {reason.value: count for reason, count in knowledge.refused.items()},
        }  # fmt: skip

    async def _show_hall(self, request: Request) -> Response:
        language, chosen = self._language(request), _filter(request)
        query = {"area": chosen.area, "state": chosen.state, "name": chosen.name, "language": language}
        own = f"?{urlencode({key: value for key, value in query.items() if value})}"
        frame = self._frame(language)
        frame.pop("here")
        with self._collector.lock:
            return HTMLResponse(self._hall.page(time.time(), language, chosen, own, frame))

    async def _show_comparison(self, request: Request) -> Response:
        language, now = self._language(request), time.time()
        knowledge, zone = self._collector.knowledge, self._settings.timezone
        with self._collector.lock:
            own = {"peers": peers(knowledge, now, language), "poor": poor_data(knowledge, now, language, zone),
                   "events": week(knowledge, now, language, zone)}  # fmt: skip
        return HTMLResponse(
            PAGES.get_template("compare.html").render(own, first=FIRST_PEERS, **self._frame(language, "compare"))
        )

    async def _show_machine(self, request: Request) -> Response:
        """Show what 'otolith report' shows, of a time for which the daemon is asked."""
        language, now = self._language(request), time.time()
        site, name = request.path_params["site"], request.path_params["machine"]
        with self._collector.lock:
            known = self._collector.knowledge.get(site, name)
            report = known.report if known else None
        if known is None:
            return await self._show_nothing(request, Exception())
        span = request.query_params.get("time", "")
        window = report.window.end - report.window.start if report else 0.0
        query = PastQuery(site, name, now - SPANS.get(span, SPANS["1h"]), now, window)
        if self._looking.locked():
            return self._message(language, "busy", 503)
        try:
            async with self._looking:
                own = language, self._settings.timezone
                history = await run_in_threadpool(past_of, self._collector.ask, query, report, own)
                page = await run_in_threadpool(received_page, history, query.since, now)
        except (ValueError, LookupError, ArithmeticError, OSError):  # anybody may have published it
            return self._message(language, "unreadable", 502)
        head = PAGES.get_template("spans.html").render(
            site=site, machine=name, spans=SPANS, span=span if span in SPANS else "1h", **self._frame(language)
        )
        headers = {OWN_POLICY: REPORT_POLICY, "refresh": f"{REFRESH}"}
        return HTMLResponse(page.replace("<header>", f"{head}<header>", 1), headers=headers)

    async def _show_nothing(self, request: Request, _: Exception) -> Response:
        return self._message(self._language(request), "not_found", 404)

    def _message(self, language: Language, word: str, status: int) -> Response:
        text = words_in(language)[word]
        return HTMLResponse(PAGES.get_template("message.html").render(text=text, **self._frame(language)), status)

    async def _show_metrics(self, _: Request) -> Response:
        with self._collector.lock:
            text = exposition(self._collector.knowledge, self._collector.dropped, self._outlets, time.time())
        return Response(text, media_type=CONTENT_TYPE)

    async def _show_health(self, _: Request) -> Response:
        is_connected = self._collector.connected
        status = {"status": "ok" if is_connected else "no daemon and no router is connected",
                  "machines": len(self._collector.knowledge), "since": round(self._started, 1),
                  "outlets": {each.name: each.reason or "ok" for each in self._outlets}}  # fmt: skip
        return JSONResponse(status, 200 if is_connected else 503)

    async def _show_live(self, request: Request) -> Response:
        return _Live(partial(self._changes, self._language(request), _filter(request)), self._live)

    async def _changes(self, language: Language, chosen: Filter, send: Callable[[str], Awaitable[None]]) -> None:
        """Send the cards that changed, once in a tick; at first all."""
        known: dict[str, int] = {}
        while True:
            now = time.time()
            with self._collector.lock:
                cards, counts = self._hall.cards(now, language, chosen), self._hall.counts(now)
                total = len(self._collector.knowledge)
            changes: dict[str, str | None] = {key: html for key, html in cards.items() if known.get(key) != hash(html)}
            changes |= dict.fromkeys(known.keys() - cards.keys())
            known = {key: hash(html) for key, html in cards.items()}
            numbers = {level.name: count for level, count in counts.items()} | {"all": total}
            events = [("card", {"id": key, "html": html}) for key, html in changes.items()] + [("counts", numbers)]
            await send("".join(f"event: {name}\ndata: {json.dumps(content)}\n\n" for name, content in events))
            await asyncio.sleep(TICK)


class _Live(Response):
    """A stream of server-sent events; a reader that does not take one in time is disconnected."""

    def __init__(
        self, run: Callable[[Callable[[str], Awaitable[None]]], Awaitable[None]], free: asyncio.Semaphore
    ) -> None:
        """``free`` has a place for each stream that may run."""
        super().__init__(media_type="text/event-stream")
        self._run, self._free = run, free

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if self._free.locked():
            text = f"{MAX_LIVE} browsers get live events already\n"
            await PlainTextResponse(text, 503)(scope, receive, send)
            return
        async with self._free:
            await self._stream(receive, send)

    async def _stream(self, receive: Receive, send: Send) -> None:
        headers = [(name, value) for name, value in self.raw_headers if name != b"content-length"]
        await send({"type": "http.response.start", "status": 200, "headers": headers})

        async def send_event(text: str) -> None:
            body = {"type": "http.response.body", "body": text.encode(), "more_body": True}
            await asyncio.wait_for(send(body), SEND_TIMEOUT)

        sending = asyncio.ensure_future(self._run(send_event))
        leaving = asyncio.ensure_future(_left(receive))
        try:
            await asyncio.wait((sending, leaving), return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in (sending, leaving):
                task.cancel()
            await asyncio.gather(sending, leaving, return_exceptions=True)


async def _left(receive: Receive) -> None:
    while (await receive())["type"] != "http.disconnect":
        pass


def _filter(request: Request) -> Filter:
    query = request.query_params
    return Filter(*(query.get(key, "")[:64] for key in ("area", "state", "name")))


def _static(name: str, kind: str) -> Callable[[Request], Awaitable[Response]]:
    content = files("otolith.site").joinpath("pages", name).read_bytes()

    async def show(_: Request) -> Response:
        return Response(content, media_type=kind)

    return show
