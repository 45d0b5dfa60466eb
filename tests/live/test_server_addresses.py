"""Choosing one interface, and the URL as a QR code that a camera can read."""

import cv2
import numpy as np
import pytest

from mrbokeh.system.errors import InputError
from viewfinder.server.endpoint import Interface, choose, interfaces, page_url, qr_text

LOOPBACK = Interface("lo", "127.0.0.1")
WIFI = Interface("wlan0", "192.168.1.7")
CABLE = Interface("eth0", "10.0.0.4")
BRIDGE = Interface("docker0", "172.17.0.1")
PUBLIC = Interface("wan", "203.0.114.9")
MESH = Interface("tailscale0", "100.101.1.2")


def test_the_private_address_on_the_way_out_is_taken() -> None:
    assert choose([LOOPBACK, BRIDGE, WIFI, CABLE], None, WIFI.address) == WIFI.address
    assert choose([LOOPBACK, WIFI], None, None) == WIFI.address
    assert choose([LOOPBACK, PUBLIC, MESH], None, PUBLIC.address) == MESH.address


def test_an_interface_may_be_named_by_name_or_address() -> None:
    for wanted in CABLE:
        assert choose([LOOPBACK, WIFI, CABLE], wanted, WIFI.address) == CABLE.address
    # Whoever names a public one wants it.
    assert choose([LOOPBACK, WIFI, PUBLIC], "wan", WIFI.address) == PUBLIC.address


def test_none_or_several_are_named() -> None:
    with pytest.raises(InputError, match=r"no interface 'eth7'.*wlan0 \(192.168.1.7\)"):
        choose([LOOPBACK, WIFI], "eth7", None)
    with pytest.raises(InputError, match=r"found 2.*docker0.*eth0"):
        choose([LOOPBACK, BRIDGE, CABLE], None, None)
    with pytest.raises(InputError, match=r"found 0.*one of none"):
        choose([LOOPBACK], None, None)
    with pytest.raises(InputError, match=r"found 0.*wan"):
        choose([LOOPBACK, PUBLIC], None, PUBLIC.address)


def test_this_machine_has_a_loopback() -> None:
    pytest.importorskip("ifaddr")
    assert "127.0.0.1" in [each.address for each in interfaces()]


def test_urls() -> None:
    assert page_url("127.0.0.1", 8080, secure=False) == "http://127.0.0.1:8080/"
    assert page_url("::1", 80, secure=True, token="a-b", path="/camera") == "https://[::1]:80/camera#token=a-b"


def test_the_qr_code_reads_as_the_url() -> None:
    pytest.importorskip("segno")
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
