"""Reading what a page sends: at most so many bytes, and JSON without the numbers that JSON does not have."""

import json
from typing import Any

from aiohttp import web

# Messages of the page are a few numbers and names; anything larger is not from the page.
LARGEST_MESSAGE = 1024
# Offers of WebRTC list codecs and addresses: Chromium's are 6 to 10 kB.
LARGEST_BODY = 65536


async def message_body(request: web.Request) -> bytes:
    """The body of a request; one beyond LARGEST_MESSAGE is refused (413) before it is read whole."""
    if (request.content_length or 0) > LARGEST_MESSAGE:
        raise web.HTTPRequestEntityTooLarge(max_size=LARGEST_MESSAGE, actual_size=request.content_length or 0)
    body = bytearray()
    async for chunk in request.content.iter_any():
        body += chunk
        if len(body) > LARGEST_MESSAGE:
            raise web.HTTPRequestEntityTooLarge(max_size=LARGEST_MESSAGE, actual_size=len(body))
    return bytes(body)


def json_value(text: str | bytes) -> Any:
    """A JSON text of a page, None if it is none (or null). NaN and Infinity are no JSON; deep nesting is no message of ours."""
    try:
        return json.loads(text, parse_constant=_refuse)
    except (ValueError, RecursionError):
        return None


def _refuse(word: str) -> None:
    raise ValueError(word)
