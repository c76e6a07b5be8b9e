"""Who may reach the page: raw requests with hosts and origins of others, tokens, and what devices say of themselves."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import lidarspec as ls
from lidarspec.errors import SourceError
from tests.view.pages import FLAT, UPGRADE, Station, answered, recorded

EVIL = "http://evil.example"
FOREIGN_ORIGINS = (EVIL, "null", "http://127.0.0.1", "https://127.0.0.1:{port}", "http://127.0.0.1:1", "http://localhost:{port}", None)
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
    """A page that is served, for requests that change nothing."""
    folder = tmp_path_factory.mktemp("page")
    (folder / "server.py").write_text("secret")
    with Station(f"sim:{FLAT}", folder) as station:
        yield station


@pytest.mark.parametrize("path", ["/", "/index.html", "/save/0.pcd", "/socket"])
@pytest.mark.parametrize("host", FOREIGN_HOSTS)
def test_a_foreign_host_is_refused(shared: Station, path: str, host: str) -> None:
    """A name of others that was made to point here (DNS rebinding) brings its own host along."""
    named = host.format(port=shared.port)
    more: dict[str, Any] = {**UPGRADE, "Origin": f"http://{named}"} if path == "/socket" else {}
    status, _, body = answered(shared.port, path, Host=named, **more)
    assert status in (400, 403)
    assert b"<title>" not in body


def test_all_names_of_this_computer_are_its_own(shared: Station) -> None:
    for name in ("127.0.0.1", "localhost", "[::1]"):
        status, _, body = answered(shared.port, "/", Host=f"{name}:{shared.port}")
        assert (status, b"<title>page</title>" in body) == (200, True), name


@pytest.mark.parametrize("origin", FOREIGN_ORIGINS)
def test_a_foreign_or_missing_origin_gets_no_socket(shared: Station, origin: str | None) -> None:
    headers = {**UPGRADE} | ({} if origin is None else {"Origin": origin.format(port=shared.port)})
    assert answered(shared.port, "/socket", **headers)[0] == 403
    own = f"http://127.0.0.1:{shared.port}"
    assert answered(shared.port, "/socket", **UPGRADE, Origin=own)[0] == 101


def test_other_pages_get_no_scan(tmp_path: Path) -> None:
    with Station(f"sim:{FLAT}", tmp_path) as station, station.page() as page:
        header, _ = page.scan()
        page.say("pause")
        page.state(lambda state: state["paused"])
        path = f"/save/{header['scan']}.csv"
        assert answered(station.port, path, Origin=EVIL)[0] == 403
        assert answered(station.port, path, Sec_Fetch_Site="cross-site")[0] == 403
        assert answered(station.port, path, Sec_Fetch_Site="same-origin")[0] == 200
        assert answered(station.port, path, Origin=f"http://127.0.0.1:{station.port}")[0] == 200


@pytest.mark.parametrize("path", ["/", "/nothing.js", "/save/0.pcd"])
def test_browsers_are_told_to_keep_to_the_page_itself(shared: Station, path: str) -> None:
    _, headers, _ = answered(shared.port, path)
    policy = dict(part.strip().partition(" ")[::2] for part in headers["content-security-policy"].split(";"))
    assert (policy["default-src"], policy["script-src"], policy["style-src"]) == ("'none'", "'self'", "'self'")
    assert (policy["frame-ancestors"], policy["base-uri"], policy["form-action"]) == ("'none'", "'none'", "'none'")
    assert not any(word in headers["content-security-policy"] for word in ("unsafe", "http:", "*"))
    assert (headers["x-content-type-options"], headers["referrer-policy"]) == ("nosniff", "no-referrer")
    assert headers["cache-control"] == "no-store"
    assert "server" not in headers


@pytest.mark.parametrize("path", ["/../server.py", "/%2e%2e/%2e%2e/etc/passwd", "//etc/passwd", "/..%5c..%5cserver.py"])
def test_only_the_files_of_the_page_are_served(shared: Station, path: str) -> None:
    status, _, body = answered(shared.port, path)
    assert status in (400, 404)
    assert b"secret" not in body


def test_elsewhere_than_here_the_link_has_a_token(tmp_path: Path) -> None:
    with Station(f"sim:{FLAT}", tmp_path, host="0.0.0.0") as station:
        token = station.link.partition("?token=")[2]
        assert len(token) >= 32
        port = int(station.link.partition("?")[0].rpartition(":")[2].strip("/"))
        own = f"http://127.0.0.1:{port}"
        for wrong in ("", "?token=", f"?token={token[:-1]}", f"?token={token}x", f"?tokem={token}"):
            assert answered(port, f"/{wrong}")[0] == 403, wrong
            assert answered(port, f"/save/0.csv{wrong}")[0] == 403, wrong
            assert answered(port, f"/socket{wrong}", **UPGRADE, Origin=own)[0] == 403, wrong
        assert answered(port, f"/?token={token}")[0] == 200
        assert answered(port, f"/save/9999.csv?token={token}")[0] == 404
        assert answered(port, f"/socket?token={token}", **UPGRADE, Origin=own)[0] == 101
        assert answered(port, f"/?token={token}", Host=f"evil.example:{port}")[0] == 403
        assert answered(port, f"/?token={token}", Host=f"192.168.7.9:{port}")[0] == 200  # one of its addresses, for all it knows


def test_here_the_link_is_plain(shared: Station) -> None:
    assert shared.link == f"http://127.0.0.1:{shared.port}/"


def test_a_port_that_is_taken_is_told_of(tmp_path: Path) -> None:
    with (
        Station(f"sim:{FLAT}", tmp_path) as station,
        pytest.raises(SourceError, match=rf"127\.0\.0\.1:{station.port}"),
    ):
        Station(f"sim:{FLAT}", tmp_path, port=station.port)


@pytest.mark.slow
def test_markup_that_a_device_sends_stays_text(tmp_path: Path) -> None:
    """The model in an answer of a hostile device, and the name of a file."""
    markup, sensor = "<script>alert(1)<!--", ls.sensor("hokuyo-ust10lx")
    told = sensor.parse(sensor.example("parameters"), "parameters")
    told["model"]["text"] = markup.encode()
    path = recorded(tmp_path, sensor.id, seconds=1.0, suffix=".bin").rename(tmp_path / "<img src=x>.bin")
    path.write_bytes(sensor.build("parameters", told) + path.read_bytes())
    with Station(path, tmp_path, sensor) as station, station.page() as page:
        assert page.until("hello")["source"].endswith("<img src=x>.bin")
        assert page.state(lambda state: state["info"].get("model"))["info"]["model"] == markup
