"""Access to the page: the token of its link, and the Host and Origin headers.

Each request must have the token of the server in its query. Other users of this computer can
connect to the server, but do not know the token. The token is not kept in a cookie, because
browsers send the cookies of one port to all ports of this computer, so a server of another user
could receive the token. The checks of the headers Host and Origin refuse requests from other pages
in the same browser.
"""

from __future__ import annotations

import ipaddress
import os
import re
import secrets
from collections.abc import Callable
from html import escape
from pathlib import Path

from starlette.datastructures import Headers, MutableHeaders, QueryParams
from starlette.responses import HTMLResponse, PlainTextResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

#: Number of random bytes in a token.
TOKEN_BYTES = 24
#: Names of this computer in its own browser.
LOCAL_NAMES = ("127.0.0.1", "localhost", "[::1]")
#: Addresses that mean all interfaces.
ANY_ADDRESS = ("0.0.0.0", "::")
HEADERS = {
    "content-security-policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "font-src 'self'; img-src 'self' data: blob:; connect-src 'self'; base-uri 'none'; "
    "form-action 'none'; frame-ancestors 'none'",
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "cache-control": "no-store",
}
OTHER_HOST = "the address names another host than this server: open the link that lidarspec printed"
OTHER_PAGE = "the request was refused, because it comes from another page"
TOKEN_NEEDED = """<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="dark light">
<title>lidarspec: token needed</title>
<h1>This page needs a token</h1>
<p>The token in the address is missing or wrong.
<p>Open the whole link that <code>lidarspec view --web</code> printed in its terminal:
it ends with <code>?token=</code> and 32 characters.
<p>Each start of lidarspec makes a new token, so the link of an earlier start is not valid any more.
</html>
"""
_OWN_FILE = re.compile(r'((?:href|src)="[\w-]+\.\w+)(?=")')


def make_token() -> str:
    """Return a new token."""
    return secrets.token_urlsafe(TOKEN_BYTES)


class Guard:
    """Passes on requests only if they come from the page, and adds security headers.

    Args:
        host: address on which the server listens.
        link_host: the host in the printed link.
        on_token: a function that is called for each request that has the token. Its argument is the
            client's (address, port), or None if they are unknown.
    """

    def __init__(
        self,
        app: ASGIApp,
        *,
        host: str,
        link_host: str,
        port: int,
        token: str,
        on_token: Callable[[tuple[str, int] | None], None],
    ) -> None:
        self._app = app
        self._on_token = on_token
        self._port = port
        self._token = token.encode()
        self._names = {*LOCAL_NAMES, link_host.lower()}
        self._is_anywhere = host in ANY_ADDRESS

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve a request, or refuse it."""
        if scope["type"] not in ("http", "websocket"):
            return
        refusal = self._check_request(scope)
        if refusal is not None and scope["type"] == "websocket":
            await send({"type": "websocket.close"})
            return

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(HEADERS)
            await send(message)

        if refusal is not None:
            await refusal(scope, receive, send_with_headers)
            return
        self._on_token(scope["client"])
        # The application does not see the token, so that it is in no log and no message.
        await self._app({**scope, "query_string": b""}, receive, send_with_headers)

    def _check_request(self, scope: Scope) -> Response | None:
        """Return the response that refuses a request; None if the request is allowed."""
        headers = Headers(scope=scope)
        host = headers.get("host", "")
        origin = headers.get("origin")
        if not self._is_own_host(host):
            return _refuse(OTHER_HOST)
        if origin is None:
            is_own_page = scope["type"] == "http"  # browsers name the origin of each socket
        else:
            is_own_page = origin == f"http://{host}"
        if scope["path"].startswith("/save/"):
            site = headers.get("sec-fetch-site", "same-origin")
            is_own_page = is_own_page and site in ("same-origin", "none")
        if not is_own_page:
            return _refuse(OTHER_PAGE)
        token = QueryParams(scope["query_string"]).get("token", "")
        if not secrets.compare_digest(token.encode(), self._token):
            return HTMLResponse(TOKEN_NEEDED, 403, {"connection": "close"})
        return None

    def _is_own_host(self, host: str) -> bool:
        """Return whether a Host header names this server."""
        # a name that is not the server's own can be made to point to this computer
        name, _, port = host.rpartition(":") if host.rpartition("]")[2] else (host, "", "")
        if (port or "80") != str(self._port):
            return False
        return name.lower() in self._names or (self._is_anywhere and is_address(name.strip("[]")))


def _refuse(reason: str) -> Response:
    return PlainTextResponse(reason, 403, {"connection": "close"})


def is_address(text: str) -> bool:
    """Return whether a text is an IP address."""
    try:
        ipaddress.ip_address(text)
    except ValueError:
        return False
    return True


def add_token(page: str, token: str) -> str:
    """Return an HTML page that loads its own scripts and styles with the token."""
    return _OWN_FILE.sub(rf"\1?token={token}", page)


def write_redirect_page(folder: Path, link: str) -> Path:
    """Write a page that redirects a browser to `link`, and return the page's path."""
    # Only the user can read the page. Other users can see the command lines of all programs, so a
    # browser is not started with the link.
    path = folder / "open.html"
    address = escape(link)
    text = (
        '<!doctype html><meta charset="utf-8"><meta name="referrer" content="no-referrer">'
        f'<meta http-equiv="refresh" content="0; url={address}"><title>lidarspec</title>'
        f'<p><a href="{address}">Open the page</a>'
    )
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    with open(descriptor, "w", encoding="utf-8") as file:
        file.write(text)
    return path
