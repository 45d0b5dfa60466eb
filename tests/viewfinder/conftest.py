"""Tests that are coroutines, and clips that several tests of the viewfinder take."""

import asyncio
import inspect
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from ipaddress import ip_address
from pathlib import Path

import numpy as np
import pytest


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    """Run a coroutine in an event loop of its own; it fails if that takes longer than 90 s."""
    if not inspect.iscoroutinefunction(pyfuncitem.obj):
        return None
    arguments = {name: pyfuncitem.funcargs[name] for name in pyfuncitem._fixtureinfo.argnames}
    asyncio.run(asyncio.wait_for(pyfuncitem.obj(**arguments), 90.0))
    return True


Make = Callable[..., tuple[Path, Path]]


@pytest.fixture
def make_certificate(tmp_path: Path) -> Make:
    """(certificate, key) as PEM files, signed by themselves."""
    x509 = pytest.importorskip("cryptography.x509")
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec

    def make(name: str = "one", days: int = 1, passphrase: bytes | None = None, *, named: bool = True) -> tuple[Path, Path]:
        key = ec.generate_private_key(ec.SECP256R1())
        subject = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, name)])
        now = datetime.now(UTC)
        builder = x509.CertificateBuilder().subject_name(subject).issuer_name(subject).public_key(key.public_key())
        builder = builder.serial_number(x509.random_serial_number()).not_valid_before(now - timedelta(days=9))
        builder = builder.not_valid_after(now + timedelta(days=days))
        if named:
            names = [x509.DNSName("Box.local"), x509.DNSName("*.example"), x509.IPAddress(ip_address("127.0.0.1"))]
            builder = builder.add_extension(x509.SubjectAlternativeName(names), critical=False)
        encryption = serialization.BestAvailableEncryption(passphrase) if passphrase else serialization.NoEncryption()
        key_pem = key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, encryption)
        paths = tmp_path / f"{name}.pem", tmp_path / f"{name}-key.pem"
        paths[0].write_bytes(builder.sign(key, hashes.SHA256()).public_bytes(serialization.Encoding.PEM))
        paths[1].write_bytes(key_pem)
        return paths

    return make


@pytest.fixture
def plate(tmp_path: Path) -> tuple[Path, np.ndarray]:
    """A lossless clip of one smooth picture at 50 frames per second, and its 8-bit codes, blue first."""
    from tests.support.layer_viewfinder import write_plate

    return write_plate(tmp_path)
