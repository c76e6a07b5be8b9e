"""Tests of access to the page: foreign hosts and origins, missing token.

They also cover hostile texts from devices.
"""

from __future__ import annotations

import os
import re
import socket
import urllib.parse
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import lidarspec as ls
from lidarspec.errors import SourceError
from lidarspec_web.access import add_token
from lidarspec_web.server import PAGE

from .pages import FLAT, UPGRADE, Station, request_raw, write_recording

EVIL = "http://evil.example"
FOREIGN_ORIGINS = (
    EVIL,
    "null",
    "http://127.0.0.1",
    "https://127.0.0.1:{port}",
    "http://127.0.0.1:1",
    "http://localhost:{port}",
    None,
)
FOREIGN_HOSTS = (
    "evil.example:{port}",
    "evil.example",
    "127.0.0.1",
    "127.0.0.1:1",
    "[::2]:{port}",
    "127.0.0.1:{port}.evil.example",
    "10.0.0.1:{port}",
    "",
)


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Station]:
    """Yield a served page for requests that change nothing."""
    folder = tmp_path_factory.mktemp("page")
    (folder / "server.py").write_text("secret")
    with Station(f"sim:{FLAT}", folder) as station:
        yield station


@pytest.mark.parametrize("path", ["/", "/index.html", "/save/0.pcd", "/socket"])
@pytest.mark.parametrize("host", FOREIGN_HOSTS)
def test_a_foreign_host_is_refused(shared: Station, path: str, host: str) -> None:
    """A foreign name that points here (DNS rebinding) has its own Host header."""
    named = host.format(port=shared.port)
    more: dict[str, Any] = {**UPGRADE, "Origin": f"http://{named}"} if path == "/socket" else {}
    status, _, body = shared.request(path, Host=named, **more)
    assert status in (400, 403)
    assert b"<title>" not in body


def test_all_names_of_this_computer_are_accepted(shared: Station) -> None:
    for name in ("127.0.0.1", "localhost", "[::1]"):
        status, _, body = shared.request("/", Host=f"{name}:{shared.port}")
        assert (status, b"<title>page</title>" in body) == (200, True), name


@pytest.mark.parametrize("origin", FOREIGN_ORIGINS)
def test_a_foreign_or_missing_origin_gets_no_socket(shared: Station, origin: str | None) -> None:
    headers = {**UPGRADE} | ({} if origin is None else {"Origin": origin.format(port=shared.port)})
    assert shared.request("/socket", **headers)[0] == 403
    own = f"http://127.0.0.1:{shared.port}"
    assert shared.request("/socket", **UPGRADE, Origin=own)[0] == 101


def test_other_pages_get_no_scan(tmp_path: Path) -> None:
    with Station(f"sim:{FLAT}", tmp_path) as station, station.page() as page:
        header, _ = page.scan()
        page.say("pause")
        page.state(lambda state: state["paused"])
        path = f"/save/{header['scan']}.csv"
        assert station.request(path, Origin=EVIL)[0] == 403
        assert station.request(path, Sec_Fetch_Site="cross-site")[0] == 403
        assert station.request(path, Sec_Fetch_Site="same-origin")[0] == 200
        assert station.request(path, Origin=f"http://127.0.0.1:{station.port}")[0] == 200


@pytest.mark.parametrize("path", ["/", "/nothing.js", "/save/0.pcd"])
def test_a_content_security_policy_is_sent(shared: Station, path: str) -> None:
    _, headers, _ = shared.request(path)
    policy = dict(
        part.strip().partition(" ")[::2] for part in headers["content-security-policy"].split(";")
    )
    assert (policy["default-src"], policy["script-src"], policy["style-src"]) == (
        "'none'",
        "'self'",
        "'self'",
    )
    assert (policy["frame-ancestors"], policy["base-uri"], policy["form-action"]) == (
        "'none'",
        "'none'",
        "'none'",
    )
    assert not any(word in headers["content-security-policy"] for word in ("unsafe", "http:", "*"))
    assert (headers["x-content-type-options"], headers["referrer-policy"]) == (
        "nosniff",
        "no-referrer",
    )
    assert headers["cache-control"] == "no-store"
    assert "server" not in headers


@pytest.mark.parametrize(
    "path", ["/../server.py", "/%2e%2e/%2e%2e/etc/passwd", "//etc/passwd", "/..%5c..%5cserver.py"]
)
def test_only_the_files_of_the_page_are_served(shared: Station, path: str) -> None:
    status, _, body = shared.request(path)
    assert status in (400, 404)
    assert b"secret" not in body


@pytest.mark.parametrize(
    "path", ["/", "/index.html", "/page.js", "/nothing.js", "/save/0.csv", "/socket", "/?"]
)
def test_nothing_is_served_without_the_token(shared: Station, path: str) -> None:
    """Other users of this computer can connect, but do not know the token."""
    token = shared.token
    assert len(token) >= 32
    more = {**UPGRADE, "Origin": f"http://127.0.0.1:{shared.port}"} if path == "/socket" else {}
    wrong = (
        "",
        "?token=",
        f"?token={token[:-1]}",
        f"?token={token}x",
        f"?tokem={token}",
        "?token=%C3%A9",
        f"#{token}",
    )
    for query in wrong:
        status, headers, body = request_raw(shared.port, f"{path}{query}", **more)
        assert status == 403, query
        assert headers["connection"] == "close"
        assert b"<title>page" not in body
        assert token.encode() not in body
    assert request_raw(shared.port, path, Cookie=f"token={token}", **more)[0] == 403
    assert request_raw(shared.port, path, Referer=shared.link, **more)[0] == 403


def test_a_refused_page_says_where_the_link_is(shared: Station) -> None:
    _, headers, body = request_raw(shared.port, "/")
    assert headers["content-type"].startswith("text/html")
    assert b"Open the whole link that <code>lidarspec view --web</code> printed" in body
    assert headers["referrer-policy"] == "no-referrer"


def test_the_page_loads_its_files_with_the_token(shared: Station) -> None:
    status, headers, body = shared.request("/")
    assert (status, headers["cache-control"]) == (200, "no-store")
    assert (
        f'<link rel="icon" href="data:,"><script src="page.js?token={shared.token}">'.encode()
        in body
    )
    assert shared.request("/index.html")[2] == body
    assert shared.request("/page.js")[2] == b"1"
    assert "set-cookie" not in headers


def test_the_built_page_names_no_file_that_would_lack_the_token() -> None:
    """Scripts and styles are in the head of the page, and load nothing themselves."""
    text = add_token((PAGE / "index.html").read_text(encoding="utf-8"), "TOKEN")
    assert re.findall(r'(?:href|src)="([^"]*)"', text) == [
        "data:,",
        "page.css?token=TOKEN",
        "page.js?token=TOKEN",
    ]
    assert "url(" not in (PAGE / "page.css").read_text(encoding="utf-8")


def test_each_server_has_a_token_of_its_own(tmp_path: Path, shared: Station) -> None:
    with Station(f"sim:{FLAT}", tmp_path) as station:
        assert station.token != shared.token
        assert request_raw(station.port, f"/?token={shared.token}")[0] == 403


def test_a_browser_is_started_with_a_file_and_not_with_the_token(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Other users see the command lines of all programs."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with Station(f"sim:{FLAT}", tmp_path) as station:
        url = station.server.opening_page()
        assert station.token not in url
        path = Path(urllib.request.url2pathname(urllib.parse.urlsplit(url).path))
        assert f'content="0; url={station.link}"' in path.read_text()
        if os.name == "posix":
            assert (path.stat().st_mode & 0o777, path.parent.stat().st_mode & 0o777) == (
                0o600,
                0o700,
            )
    assert not path.parent.exists()


def test_all_addresses_and_its_own_name_reach_a_server_at_all_interfaces(tmp_path: Path) -> None:
    with Station(f"sim:{FLAT}", tmp_path, host="0.0.0.0") as station:
        name, port = socket.gethostname(), station.port
        assert station.link.startswith(f"http://{name}:{port}/?token=")
        for host in (name, name.upper(), "192.168.7.9"):
            assert station.request("/", Host=f"{host}:{port}")[0] == 200
        assert station.request("/", Host=f"evil.example:{port}")[0] == 403


def test_a_port_in_use_is_reported(tmp_path: Path) -> None:
    with (
        Station(f"sim:{FLAT}", tmp_path) as station,
        pytest.raises(SourceError, match=rf"127\.0\.0\.1:{station.port}"),
    ):
        Station(f"sim:{FLAT}", tmp_path, port=station.port)


@pytest.mark.slow
def test_markup_that_a_device_sends_stays_text(tmp_path: Path) -> None:
    """The model in a reply of a hostile device, and the name of a file."""
    markup, sensor = "<script>alert(1)<!--", ls.sensor("hokuyo-ust10lx")
    told = sensor.parse(sensor.example("parameters"), "parameters")
    told["model"]["text"] = markup.encode()
    path = write_recording(tmp_path, sensor.id, seconds=1.0, suffix=".bin").rename(
        tmp_path / "<img src=x>.bin"
    )
    path.write_bytes(sensor.build("parameters", told) + path.read_bytes())
    with Station(path, tmp_path, sensor) as station, station.page() as page:
        assert page.until("hello")["source"].endswith("<img src=x>.bin")
        assert page.state(lambda state: state["info"].get("model"))["info"]["model"] == markup
