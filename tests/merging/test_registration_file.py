"""registration.json."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from capture.merging.registration.registration_file import Breathing, Registration, read_registration, write_registration
from tests.support.refusals import refused

REGISTRATION = Registration(
    reference=1,
    reference_from_slice=(np.array([[1.01, -1e-4, 0.3], [1e-4, 1.01, -0.7]]), np.eye(2, 3), np.array([[1.02, 0, 1 / 3], [0, 1.02, 2]])),
    correlations=(0.99, 0.2),
    residuals_px=(0.05, 0.05, None),
    size_px=(640, 428),
    breathing=Breathing((1.0, 1.01, 0.99), "pictures", 0.013),
)


TURNED = np.array([[1.0, 0.0, 2.0], [0.0, 1.0, 1.0], [1e-6, -2e-6, 1.0]])


@pytest.mark.parametrize(
    "registration",
    [
        REGISTRATION,
        replace(REGISTRATION, reference_from_slice=(TURNED, np.eye(2, 3), TURNED)),
        replace(REGISTRATION, breathing=None, size_px=None, camera_moved=False),
    ],
)
def test_what_is_written_is_read_to_the_last_bit(tmp_path: Path, registration: Registration) -> None:
    write_registration(tmp_path / "registration.json", registration)
    found = read_registration(tmp_path / "registration.json", slices=3)
    for a, b in zip(found.reference_from_slice, registration.reference_from_slice, strict=True):
        np.testing.assert_array_equal(a, b)
    assert replace(found, reference_from_slice=()) == replace(registration, reference_from_slice=())


def test_a_person_can_read_it(tmp_path: Path) -> None:
    write_registration(tmp_path / "registration.json", REGISTRATION)
    document = json.loads((tmp_path / "registration.json").read_text())
    assert document["residuals_px"] == [0.05, 0.05, None] and document["breathing"]["source"] == "pictures"


def test_a_file_of_another_stack_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "registration.json"
    write_registration(path, REGISTRATION)
    refused("registers 3 slices, but the stack has 5", read_registration, path, slices=5)


@pytest.mark.parametrize("change", [
    {"format": "something else"},
    {"reference": 3},
    {"correlations": None},
    {"reference_from_slice": [[[1, 0, 0], [0, 1]]] * 3},
    {"reference_from_slice": [[[0, 0, 0], [0, 0, 0]]] * 3},
    {"breathing": {"scales": [1.0]}},
])  # fmt: skip
def test_a_broken_file_gets_one_clear_line(tmp_path: Path, change: dict) -> None:
    path = tmp_path / "registration.json"
    write_registration(path, REGISTRATION)
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    refused("delete", read_registration, path)
