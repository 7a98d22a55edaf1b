"""Who is let in: by the token, and by what a browser says of the page that asks."""

import asyncio
import base64
import socket
import time
from http import HTTPStatus
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from unmix_plugin.viewer.authentication import MOST_PAGES, Authentication, WarningsOfStrangers

HERE = {"host": "127.0.0.1:7007"}
OPENING = {**HERE, "upgrade": "websocket"}


def with_word(word, headers=HERE):
    return {**headers, "authorization": "Basic " + base64.b64encode(f":{word}".encode()).decode()}


def asked(authentication, headers=HERE, page=0, port=7007) -> Any:
    return asyncio.run(authentication.refusal(page, headers, "10.0.0.1", port))


def quick(token, say=lambda _: None, host="127.0.0.1"):
    """An authentication that answers in no time."""
    return Authentication(host, token, say, guess_s=0.001, room_s=0.0)


@given(st.text().filter(lambda word: word != "sésame"))
@settings(max_examples=30)
def test_only_the_token_itself_is_admitted(word):
    authentication = quick("sésame")
    assert asked(authentication, with_word(word)).status == HTTPStatus.UNAUTHORIZED
    assert asked(authentication, with_word("sésame", OPENING)) is None


def test_the_token_is_asked_for_once_and_a_cookie_stands_for_it():
    authentication = quick("sesame")
    asking = asked(authentication)
    assert (asking.status, "asks for the token" in asking.text) == (HTTPStatus.UNAUTHORIZED, True)
    assert asked(authentication, OPENING).status == HTTPStatus.UNAUTHORIZED
    cookie = asked(authentication, with_word("sesame")).headers["Set-Cookie"]
    assert "HttpOnly" in cookie
    assert "SameSite=Strict" in cookie
    assert "sesame" not in cookie
    given = {"cookie": cookie.partition(";")[0]}
    assert asked(authentication, {**HERE, **given}) is None
    assert asked(authentication, {**OPENING, **given}) is None
    assert asked(authentication, {**OPENING, **given}, port=7008).status == HTTPStatus.UNAUTHORIZED
    assert asked(quick("sesame"), {**HERE, **given}).status == HTTPStatus.UNAUTHORIZED
    assert (
        asked(authentication, {**OPENING, **given, "origin": "http://127.0.0.1:8000"}).status
        == HTTPStatus.FORBIDDEN
    )


def test_each_address_has_one_guess_checked_at_a_time_and_a_limited_number_waiting():
    authentication, ended = Authentication("127.0.0.1", "sesame", guess_s=0.02), []

    async def guess(number, word, address):
        refusal: Any = await authentication.refusal(number, with_word(word), address, 7007)
        ended.append((number, refusal.status))

    async def crowd():
        many = [guess(number, "barley", "10.0.0.1") for number in range(30)]
        await asyncio.gather(*many, guess(100, "sesame", "10.0.0.2"))

    asyncio.run(crowd())
    refused = [number for number, status in ended if status == HTTPStatus.TOO_MANY_REQUESTS]
    assert len(refused) == 30 - 16
    assert ended.index((100, HTTPStatus.OK)) <= len(refused) + 1
    waited = [number for number, _ in ended if number not in (*refused, 100)]
    assert waited == sorted(waited)


def test_guesses_from_many_addresses_are_slowed_together():
    """A network of many addresses gets no further through a dictionary than one."""
    authentication, ended = Authentication("127.0.0.1", "sesame", guess_s=0.02), []

    async def guess(address):
        refusal: Any = await authentication.refusal(address, with_word("barley"), address, 7007)
        ended.append((time.monotonic(), refusal.status))

    async def crowd():
        await asyncio.gather(*(guess(f"10.0.0.{number}") for number in range(30)))

    begun = time.monotonic()
    asyncio.run(crowd())
    assert {status for _, status in ended} == {HTTPStatus.UNAUTHORIZED}
    assert max(at for at, _ in ended) - begun >= 30 * 0.02
    ended.clear()

    async def larger_crowd():
        await asyncio.gather(*(guess(f"10.0.{number}.1") for number in range(100)))

    asyncio.run(larger_crowd())
    refused = [status for _, status in ended if status == HTTPStatus.TOO_MANY_REQUESTS]
    assert len(refused) == 100 - 64


def test_all_addresses_of_one_network_of_ipv6_are_one_guesser():
    authentication, refused = Authentication("127.0.0.1", "sesame", guess_s=0.002), []

    async def guess(address):
        refusal: Any = await authentication.refusal(address, with_word("barley"), address, 7007)
        refused.append(refusal.status == HTTPStatus.TOO_MANY_REQUESTS)

    async def crowd():
        await asyncio.gather(*(guess(f"2001:db8::{number}") for number in range(30)))

    asyncio.run(crowd())
    assert sum(refused) == 30 - 16


def test_places_are_limited_and_given_back():
    authentication = quick(None)
    assert all(asked(authentication, OPENING, page) is None for page in range(MOST_PAGES))
    for headers in (OPENING, HERE):
        refusal = asked(authentication, headers, 100)
        assert refusal.status == HTTPStatus.SERVICE_UNAVAILABLE
        assert "16 pages are open already" in refusal.text
    authentication.leave(3)
    authentication.leave(3)
    assert asked(authentication) is None  # what is only read takes no place
    assert asked(authentication, OPENING, 100) is None
    assert asked(authentication, OPENING, 101) is not None


def test_foreign_pages_take_no_place_and_their_site_is_said_once():
    said = []
    authentication = quick(None, said.append)
    for page in range(64):
        refusal = asked(authentication, {**OPENING, "origin": "http://evil.example\x1b[2J"}, page)
        assert refusal.status == HTTPStatus.FORBIDDEN
    assert len(said) == 1
    assert "another site (http://evil.example[2J)" in said[0]
    for number in range(100):
        asked(authentication, {**OPENING, "origin": f"http://{number}.example"})
    assert len(said) == 16
    assert asked(authentication, OPENING) is None


MINE = socket.gethostname()


@pytest.mark.parametrize(
    ("origin", "host", "is_own"),
    [
        ("http://127.0.0.1:7007", "127.0.0.1:7007", True),
        ("http://LOCALHOST:7007", "localhost:7007", True),
        ("http://[::1]:7007", "[::1]:7007", True),
        ("http://192.168.1.5:7007", "192.168.1.5:7007", True),
        (None, "127.0.0.1:7007", True),
        (None, None, True),
        ("https://127.0.0.1:7007", "127.0.0.1:7007", False),
        ("ftp://127.0.0.1:7007", "127.0.0.1:7007", False),
        ("http://[::1", "[::1", False),
        (None, "rebound.example:7007", False),
        ("https://evil.example", "127.0.0.1:7007", False),
        ("http://127.0.0.1:8000", "127.0.0.1:7007", False),
        ("null", "127.0.0.1:7007", False),
        ("http://rebound.example:7007", "127.0.0.1:7007", False),
        ("http://rebound.example:7007", "rebound.example:7007", False),
        ("http://localhost:7007", None, False),
    ],
)
def test_pages_of_other_sites_are_told_by_their_origin_and_host(origin, host, is_own):
    headers = {name: value for name, value in (("origin", origin), ("host", host)) if value is not None}
    assert (asked(quick(None), headers) is None) is is_own


@pytest.mark.parametrize(
    ("origin", "host", "listens_at", "has_token", "is_own"),
    [
        ("https://lab.example", {"host": "lab.example"}, "127.0.0.1", True, True),
        ("https://lab.example", {**HERE, "x-forwarded-host": "lab.example"}, "127.0.0.1", True, True),
        ("https://lab.example", HERE, "127.0.0.1", True, False),
        ("http://127.0.0.1:8000", HERE, "127.0.0.1", True, False),
        ("null", HERE, "127.0.0.1", True, False),
        ("http://lab.example:7007", {"host": "lab.example:7007"}, "lab.example", False, True),
        ("http://lab.example:7007", {"host": "lab.example:7007"}, "0.0.0.0", False, False),
        (f"http://{MINE}:7007", {"host": f"{MINE}:7007"}, "0.0.0.0", False, True),
    ],
)
def test_with_the_token_a_page_may_come_through_a_proxy(origin, host, listens_at, has_token, is_own):
    authentication = quick("sesame" if has_token else None, host=listens_at)
    headers = {"origin": origin, "upgrade": "websocket", **host}
    refusal = asked(authentication, with_word("sesame", headers) if has_token else headers)
    assert (refusal is None) is is_own
    assert is_own or refusal.status == HTTPStatus.FORBIDDEN


def test_warnings_of_strangers_are_short_and_one_of_each_kind():
    said = []
    warnings = WarningsOfStrangers(said.append)
    for number in range(1000):
        warnings.warn("ValueError", f"{number} " + "x" * 10_000)
        warnings.warn(f"{number}", "another")
    assert sum(line.startswith("warning: 0 x") for line in said) == 1
    assert len(said) == 16
    assert all(len(line) <= 400 for line in said)


def test_a_malformed_cookie_of_another_program_does_not_hide_ours_and_malformed_words_are_wrong_ones():
    authentication = quick("sesame")
    ours = asked(authentication, with_word("sesame")).headers["Set-Cookie"].partition(";")[0]
    for other in ('a={"x":1}', "flag", "a=b c", "é=1"):
        assert asked(authentication, {**HERE, "cookie": f"{other}; {ours}"}) is None
    assert asked(authentication, {**HERE, "cookie": f"{ours}x"}).status == HTTPStatus.UNAUTHORIZED
    for words in ("", "Basic", "Basic ?", "Basic c2VzYW1l", "Bearer OnNlc2FtZQ==", "\xff"):
        assert asked(authentication, {**HERE, "authorization": words}).status == HTTPStatus.UNAUTHORIZED
