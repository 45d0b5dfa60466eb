"""TLS with the user's own certificate: loading it, and the names it is good for."""

import ssl
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

from mrbokeh.system.errors import InputError, MissingExtraError


class Tls(NamedTuple):
    """context: for the server. names: host names and addresses that the certificate covers, in lower case, without wildcards."""

    context: ssl.SSLContext
    names: tuple[str, ...]


def load_tls(certificate: Path, key: Path | None = None) -> Tls:
    """A certificate chain in PEM and its key, which may be in the same file; InputError says what is wrong with them."""
    key = key or certificate
    for path, what in ((certificate, "certificate"), (key, "key")):
        if not path.is_file():
            raise InputError(f"there is no {what} file {path}: make one with `mkcert`, or give the {what} you have")
    names = _names(certificate)
    if b"ENCRYPTED" in key.read_bytes():
        # A pass phrase would be asked for in the middle of a shoot.
        raise InputError(f"the key {key} has a pass phrase: remove it with `openssl pkey -in {key} -out PLAIN.pem`")
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    try:
        context.load_cert_chain(certificate, key)
    except ssl.SSLError as error:
        raise InputError(_refused(certificate, key, error)) from None
    except OSError as error:
        raise InputError(f"the certificate {certificate} or its key {key} cannot be read ({error.strerror})") from None
    return Tls(context, names)


def _names(certificate: Path) -> tuple[str, ...]:
    try:
        from cryptography import x509
    except ImportError:
        raise MissingExtraError("cryptography", "viewfinder") from None
    try:
        loaded = x509.load_pem_x509_certificates(certificate.read_bytes())[0]
    except (ValueError, OSError):
        raise InputError(f"{certificate} holds no certificate in PEM (-----BEGIN CERTIFICATE-----): convert it with openssl") from None
    if loaded.not_valid_after_utc < datetime.now(UTC):
        raise InputError(f"the certificate {certificate} expired on {loaded.not_valid_after_utc:%Y-%m-%d}: make a new one")
    try:
        alternative = loaded.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        raise InputError(
            f"the certificate {certificate} names no host (no subjectAltName), so no browser accepts it: make it anew"
        ) from None
    names: list[Any] = [*alternative.get_values_for_type(x509.DNSName), *alternative.get_values_for_type(x509.IPAddress)]
    return tuple(str(name).lower() for name in names if "*" not in str(name))


def _refused(certificate: Path, key: Path, error: ssl.SSLError) -> str:
    if error.reason == "KEY_VALUES_MISMATCH":
        return f"the key {key} does not belong to the certificate {certificate}: give the key that was made with it"
    return f"the certificate {certificate} and the key {key} cannot be used ({error.reason or error}): expected a key in PEM"
