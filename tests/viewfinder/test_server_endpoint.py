"""One interface, its URL as a QR code that a camera can read, and TLS with certificates made here, good and bad ones."""

import asyncio
import os
import signal
import ssl
from pathlib import Path

import aiohttp
import cv2
import numpy as np
import pytest

from tests.support.made_viewfinder import made_viewfinder
from tests.support.refusals import refused
from tests.viewfinder.conftest import Make
from viewfinder.options import ListeningOptions
from viewfinder.server.access import LOOPBACK_NAMES, Access
from viewfinder.server.endpoint import Endpoint, Interface, choose, interfaces, load_tls, on_stop, open_endpoint, page_url, qr_text
from viewfinder.server.sessions import Role, Sessions

LOOPBACK, WIFI, CABLE = Interface("lo", "127.0.0.1"), Interface("wlan0", "192.168.1.7"), Interface("eth0", "10.0.0.4")
BRIDGE, PUBLIC, MESH = Interface("docker0", "172.17.0.1"), Interface("wan", "203.0.114.9"), Interface("tailscale0", "100.101.1.2")


def test_the_private_address_on_the_way_out_is_taken_unless_one_is_named() -> None:
    assert choose([LOOPBACK, BRIDGE, WIFI, CABLE], None, WIFI.address) == WIFI.address
    assert choose([LOOPBACK, WIFI], None, None) == WIFI.address
    assert choose([LOOPBACK, PUBLIC, MESH], None, PUBLIC.address) == MESH.address
    for wanted in CABLE:
        assert choose([LOOPBACK, WIFI, CABLE], wanted, WIFI.address) == CABLE.address
    # Whoever names a public one wants it.
    assert choose([LOOPBACK, WIFI, PUBLIC], "wan", WIFI.address) == PUBLIC.address


def test_none_or_several_are_named() -> None:
    for found, wanted, on_the_way, sentence in (
        ([LOOPBACK, WIFI], "eth7", None, r"no interface 'eth7'.*wlan0 \(192.168.1.7\)"),
        ([LOOPBACK, BRIDGE, CABLE], None, None, r"found 2.*docker0.*eth0"),
        ([LOOPBACK], None, None, r"found 0.*one of none"), ([LOOPBACK, PUBLIC], None, PUBLIC.address, r"found 0.*wan"),
    ):  # fmt: skip
        refused(sentence, choose, found, wanted, on_the_way)
    pytest.importorskip("ifaddr")
    assert "127.0.0.1" in [each.address for each in interfaces()]


@pytest.mark.skipif(os.name == "nt", reason="no handlers can be set there")
async def test_ctrl_c_and_sigterm_stop_it() -> None:
    for number in (signal.SIGINT, signal.SIGTERM):
        stopped = asyncio.Event()
        on_stop(stopped.set)
        os.kill(os.getpid(), number)
        await asyncio.wait_for(stopped.wait(), 5)


def test_the_qr_code_reads_as_the_url() -> None:
    pytest.importorskip("segno")
    assert page_url("127.0.0.1", 8080, secure=False) == "http://127.0.0.1:8080/"
    assert page_url("::1", 80, secure=True, token="a-b", path="/camera") == "https://[::1]:80/camera#token=a-b"
    url = page_url("192.168.1.7", 8080, secure=False, token="x" * 32)
    plain = qr_text(url, colored=False)
    read, *_ = cv2.QRCodeDetector().detectAndDecode(drawn(plain))
    assert read == url
    assert all(line == f"\x1b[97;40m{bare}\x1b[0m" for line, bare in zip(qr_text(url).split("\n"), plain.split("\n"), strict=True))


def drawn(text: str) -> np.ndarray:
    """The terminal's half blocks as a picture of 8 px per module: a block is light, as on a dark terminal."""
    halves = {" ": (0, 0), "▀": (1, 0), "▄": (0, 1), "█": (1, 1)}
    cells = np.array([[halves[letter] for letter in line] for line in text.splitlines()], np.uint8)
    modules = cells.transpose(0, 2, 1).reshape(-1, cells.shape[1])
    bordered = np.pad(255 * modules, 2, constant_values=255)
    return np.kron(bordered, np.ones((8, 8), np.uint8))


async def test_the_page_the_stream_and_the_cookie_travel_encrypted(make_certificate: Make) -> None:
    certificate, key = make_certificate()
    tls = load_tls(certificate, key)
    assert tls.names == ("box.local", "127.0.0.1")
    sessions = Sessions()
    trusting = ssl.create_default_context(cafile=str(certificate))
    access = Access(names=LOOPBACK_NAMES | set(tls.names), sessions=sessions, secure=True)
    async with (
        made_viewfinder(access, tls) as made,
        aiohttp.ClientSession(cookie_jar=aiohttp.CookieJar(unsafe=True), connector=aiohttp.TCPConnector(ssl=trusting)) as client,
    ):
        assert made.url.startswith("https://127.0.0.1:")
        async with client.post(made.url + "enter", json={"token": sessions.invitation(Role.CONTROL)}) as answer:
            assert answer.status == 200 and "Secure" in answer.headers["Set-Cookie"]
        async with client.ws_connect(made.url + "stream") as stream:
            assert (await stream.receive(timeout=5)).type is aiohttp.WSMsgType.BINARY
        async with client.get(made.url) as page:
            assert "wss://127.0.0.1" in page.headers["Content-Security-Policy"]
        async with client.get(made.url + "state", headers={"Host": "box.local"}) as answer:
            assert answer.status == 401  # known name, other cookie
        with pytest.raises(aiohttp.ClientError):
            await client.get(made.url.replace("https", "http"))


async def test_the_address_has_a_name_of_the_certificate(make_certificate: Make) -> None:
    """Certificate and key may share a file."""
    certificate, key = make_certificate()
    both = certificate.with_name("both.pem")
    both.write_bytes(key.read_bytes() + certificate.read_bytes())
    for host, name in (("127.0.0.1", "127.0.0.1"), ("127.0.0.2", "box.local")):
        async with made_viewfinder(tls=load_tls(both), host=host) as made:
            assert made.url.startswith(f"https://{name}:")


def test_what_cannot_be_used_is_named(make_certificate: Make, tmp_path: Path) -> None:
    certificate, key = make_certificate()
    rubbish = tmp_path / "rubbish.pem"
    rubbish.write_bytes(b"\x30\x82 no PEM")
    cases = [
        ((tmp_path / "absent.pem", key), "no certificate file .*absent.pem.*mkcert"),
        ((certificate, tmp_path / "absent.pem"), "no key file .*absent.pem"),
        ((rubbish, key), "rubbish.pem holds no certificate in PEM"),
        ((certificate, rubbish), "cannot be used"),
        ((certificate, None), "cannot be used"),
        ((certificate, make_certificate("two")[1]), "two-key.pem does not belong to the certificate"),
        (make_certificate("old", days=-1), "old.pem expired on"),
        (make_certificate("locked", passphrase=b"secret"), "locked-key.pem has a pass phrase"),
        (make_certificate("nameless", named=False), "names no host"),
    ]
    for files, expected in cases:
        refused(expected, load_tls, *files)


def test_what_is_printed_for_a_network(capsys: pytest.CaptureFixture[str]) -> None:
    """The QR code is drawn with half blocks, as long as nobody asks for none. A token that was used is followed by the next."""
    sessions, url = Sessions(), "https://10.0.0.1:8080/"
    for qr in (True, False):
        endpoint = Endpoint(ListeningOptions(lan=True, qr=qr), "10.0.0.1", None, Access(sessions=sessions))
        endpoint.announce("viewfinder of x", url)
        endpoint.announce_camera(url)
        shown = capsys.readouterr().out
        assert ("\u2588" in shown or "\u2584" in shown) == qr
        assert f"to control, for one device: {url}#token={sessions.invitation(Role.CONTROL)}" in shown
        assert f"to send a camera from a browser: {url}camera#token={sessions.standing_token(Role.CONTROL)}" in shown
        assert f"{url}whip with the bearer token {sessions.standing_token(Role.CONTROL)}" in shown
    used = sessions.invitation(Role.CONTROL)
    assert sessions.enter(used) is not None
    assert f"#token={sessions.invitation(Role.CONTROL)}" in capsys.readouterr().out != used
    alone = open_endpoint(ListeningOptions())
    alone.announce("viewfinder of x", "http://127.0.0.1:8080/")
    assert capsys.readouterr().out == "viewfinder of x: http://127.0.0.1:8080/ (Ctrl-C stops it)\n"
