"""Names in offers become the address that the offer came from, and nothing else changes."""

import pytest

from viewfinder.streaming.session_description import with_address

NAMED = "a=candidate:383979905 1 udp 2113937151 05002700-30d8-431e-98c5-8a90d07e5099.local 42153 typ host generation 0 network-cost 999\r\n"
"""As headless Chromium writes it."""

ANSWERED = "a=candidate:383979905 1 udp 2113937151 192.168.1.7 42153 typ host generation 0 network-cost 999\r\n"
PLAIN = "a=candidate:1 1 udp 2113937151 10.0.0.3 9000 typ host\r\na=candidate:2 1 udp 1677 198.51.100.4 9000 typ srflx raddr 0.0.0.0\r\n"
REST = "v=0\r\no=- 1 1 IN IP4 host.local 42153 typ\r\na=mid:0\r\n"


def test_names_become_the_address_and_the_rest_stays() -> None:
    second = NAMED.replace("42153", "5000").replace("05002700", "A7FF5B81").replace(".local", ".LOCAL")
    expected = REST + ANSWERED + PLAIN + ANSWERED.replace("42153", "5000")
    assert with_address(REST + NAMED + PLAIN + second, "192.168.1.7") == expected


@pytest.mark.parametrize(
    ("remote", "written"),
    [("::1", "::1"), ("2001:db8::5", "2001:db8::5"), ("::ffff:192.168.1.7", "192.168.1.7")],
)
def test_addresses_of_the_other_kind(remote: str, written: str) -> None:
    assert with_address(NAMED, remote) == ANSWERED.replace("192.168.1.7", written)


@pytest.mark.parametrize("remote", [None, "", "phone.lan", "fe80::1%eth0", "192.168.1.7 evil", "a\r\na=x"])
def test_what_is_no_address_for_all_is_not_written(remote: str | None) -> None:
    assert with_address(NAMED, remote) == NAMED
