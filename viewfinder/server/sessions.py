"""Sessions: one-time invitations, which become cookies, and the two roles; RateLimit. All is kept in memory and ends with the server."""

import hashlib
import secrets
import time
from collections import OrderedDict
from collections.abc import Callable
from enum import IntEnum

# More addresses than any home or studio has; the one that was quiet for longest is forgotten first.
_MOST_ADDRESSES = 1024


class RateLimit:
    """Bucket per address that holds `burst` events and fills with `per_s` of them each second. For one thread."""

    def __init__(self, per_s: float, burst: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._per_s, self._burst, self._clock = per_s, burst, clock
        self._left: OrderedDict[str, tuple[float, float]] = OrderedDict()

    def allows(self, address: str) -> bool:
        """Take one event from the bucket of an address; False if it is empty, and then nothing is taken."""
        now_s = self._clock()
        left, since_s = self._left.pop(address, (self._burst, now_s))
        left = min(self._burst, left + (now_s - since_s) * self._per_s)
        allowed = left >= 1.0
        self._left[address] = (left - 1.0 if allowed else left, now_s)
        if len(self._left) > _MOST_ADDRESSES:
            self._left.popitem(last=False)
        return allowed


_TOKEN_BYTES = 24
_MOST_SESSIONS = 64


class Role(IntEnum):
    """Role of a visitor; who may control may also view."""

    VIEW = 1
    CONTROL = 2

    @property
    def word(self) -> str:
        """Word for the role: "view" or "control"."""
        return self.name.lower()


def _ignore(_role: Role) -> None:
    """Ignore the news."""


class Sessions:
    """Sessions with one invitation per role, good for one entry; `renewed` is told the role when the next invitation is ready.

    Programs such as OBS, which begin anew without asking anybody, use a standing token: to enter, or as a bearer (RFC 6750).
    """

    def __init__(self, renewed: Callable[[Role], None] = _ignore) -> None:
        self.renewed = renewed
        self._invitations = {role: secrets.token_urlsafe(_TOKEN_BYTES) for role in Role}
        self._roles: OrderedDict[str, Role] = OrderedDict()
        self._standing = {role: secrets.token_urlsafe(_TOKEN_BYTES) for role in Role}

    def invitation(self, role: Role) -> str:
        """Return the token that the next one who enters in this role must bring."""
        return self._invitations[role]

    def standing_token(self, role: Role) -> str:
        """Return the token of a role that is never used up."""
        return self._standing[role]

    def enter(self, token: str) -> tuple[str, Role] | None:
        """Exchange a token for (the value of a cookie, a role); None if it is wrong or spent."""
        invited, standing = _role_of(token, self._invitations), _role_of(token, self._standing)
        role = invited or standing
        if role is None:
            return None
        cookie = secrets.token_urlsafe(_TOKEN_BYTES)
        self._roles[_digest(cookie)] = role
        if len(self._roles) > _MOST_SESSIONS:
            self._roles.popitem(last=False)
        if invited is not None:
            self._invitations[role] = secrets.token_urlsafe(_TOKEN_BYTES)
            self.renewed(role)
        return cookie, role

    def role_of(self, cookie: str | None, authorization: str | None) -> Role | None:
        """Return the role of a cookie's value, or of an Authorization header; None for a stranger."""
        if authorization is not None:
            return _role_of(authorization.removeprefix("Bearer "), self._standing)
        return None if cookie is None else self._roles.get(_digest(cookie))


def _role_of(token: str, tokens: dict[Role, str]) -> Role | None:
    return next((role for role, expected in tokens.items() if _same(token, expected)), None)


def _digest(secret: str) -> str:
    """Hash a secret; looked up instead of it, so that the time a look-up takes tells nothing about it."""
    return hashlib.sha256(secret.encode("utf-8", "surrogatepass")).hexdigest()


def _same(given: str, expected: str) -> bool:
    return secrets.compare_digest(_digest(given), _digest(expected))
