"""The gallery over a real server: takes that the recorder wrote and a bundle; only its own files, and only for who controls."""

import io
import shutil
import zipfile
from pathlib import Path

import aiohttp
import av
import cv2
import numpy as np
import pytest

from mrbokeh.optics.camera import Camera
from mrbokeh.stacks.capture_bundle import read_bundle, write_bundle
from tests.support.layer_viewfinder import HEIGHT, LENS, WIDTH, bright_square
from tests.support.made_viewfinder import made_viewfinder
from tests.support.streaming_viewers import bars, output
from viewfinder.app.live_controls import plate_png
from viewfinder.server.access import LOOPBACK_NAMES, Access
from viewfinder.server.gallery import Gallery
from viewfinder.server.sessions import Role, Sessions
from viewfinder.streaming.recording import Recorder

TAKE, CAPTURE = "viewfinder-20261127-101500.mp4", "20261127-101530"


def saved(folder: Path) -> Path:
    """A folder with a take of 2 s, a capture, a take under way, and things that are nobody's."""
    recorder = Recorder(lambda: "bt709", lambda _: None, waiting=100)
    recorder.start(folder / TAKE)
    for i in range(61):
        recorder.show(output(bars(), i, i / 30))
    recorder.stop()
    (folder / "viewfinder-20261127-101600.recording.mp4").write_bytes(b"under way")
    (folder / "private.mp4").write_bytes(b"nobody's")
    (folder / "20261127-101531").mkdir()
    grey = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
    preview = bytes(cv2.imencode(".jpg", grey)[1])
    camera = Camera(WIDTH, HEIGHT, (200.0, 200.0), (WIDTH / 2, HEIGHT / 2))
    write_bundle(folder / CAPTURE, plate_png(grey, "srgb"), preview, [bright_square()], LENS, camera, "scatter", {})
    return folder


async def test_what_was_saved_is_listed_shown_kept_and_deleted(tmp_path: Path) -> None:
    folder = saved(tmp_path / "captures")
    async with made_viewfinder(gallery=Gallery(folder)) as made, aiohttp.ClientSession(made.url) as client:
        async with client.get("/state") as answer:
            assert (await answer.json())["gallery"] is True
        async with client.get("/gallery") as answer:
            told = await answer.json()
        listed = {each["name"]: each for each in told["saved"]}
        assert told["free_bytes"] == pytest.approx(shutil.disk_usage(folder).free, rel=0.2)
        assert set(listed) == {TAKE, CAPTURE} and [listed[each]["kind"] for each in (TAKE, CAPTURE)] == ["take", "capture"]
        assert listed[TAKE]["size_bytes"] == (folder / TAKE).stat().st_size and listed[TAKE]["length_s"] == pytest.approx(2.0, abs=0.1)
        for name, height in ((TAKE, 180), (CAPTURE, HEIGHT)):
            async with client.get(f"/gallery/{name}/small") as answer:
                small = cv2.imdecode(np.frombuffer(await answer.read(), np.uint8), cv2.IMREAD_COLOR)
            assert answer.content_type == "image/jpeg" and small.shape[0] == height
        # Players ask for parts.
        async with client.get(f"/gallery/{TAKE}/shown", headers={"Range": "bytes=4-7"}) as answer:
            assert (answer.status, await answer.read(), answer.content_type) == (206, b"ftyp", "video/mp4")
        async with client.get(f"/gallery/{CAPTURE}/shown") as answer:
            assert answer.content_type == "image/jpeg"
        async with client.get(f"/gallery/{TAKE}/file") as answer:
            assert f'filename="{TAKE}"' in answer.headers["Content-Disposition"]
            with av.open(io.BytesIO(await answer.read())) as container:
                assert sum(1 for _ in container.decode(video=0)) == 61
        async with client.get(f"/gallery/{CAPTURE}/file") as answer:
            with zipfile.ZipFile(io.BytesIO(await answer.read())) as archive:
                archive.extractall(tmp_path / "kept")
        assert read_bundle(tmp_path / "kept" / CAPTURE).renderer == "scatter"
        for name in (TAKE, CAPTURE):
            async with client.delete(f"/gallery/{name}") as answer:
                assert answer.status == 200
            async with client.get(f"/gallery/{name}/small") as answer:
                assert answer.status == 404
        assert sorted(each.name for each in folder.iterdir()) == [
            "20261127-101531", "private.mp4", "viewfinder-20261127-101600.recording.mp4"
        ]  # fmt: skip


async def test_nothing_but_its_own_files_can_be_named_and_guests_see_nothing(tmp_path: Path) -> None:
    folder = saved(tmp_path / "captures")
    (tmp_path / TAKE).write_bytes(b"outside")
    sessions = Sessions()
    async with made_viewfinder(Access(LOOPBACK_NAMES, sessions), gallery=Gallery(folder)) as made:
        control, view = ({"Authorization": f"Bearer {sessions.standing_token(role)}"} for role in (Role.CONTROL, Role.VIEW))
        theirs = ("private.mp4", "20261127-101531", "viewfinder-20261127-101600.recording.mp4")
        names = (*theirs, f"%2e%2e%2f{TAKE}", "..", "%2e%2e", "x" * 300)
        async with aiohttp.ClientSession(made.url) as client:
            for name in names:
                for method, what in (("GET", "/small"), ("GET", "/shown"), ("GET", "/file"), ("DELETE", "")):
                    async with client.request(method, f"/gallery/{name}{what}", headers=control) as answer:
                        assert answer.status in (404, 405), name
            for headers, status in ((view, 403), ({}, 401)):
                for method, address in (("GET", "/gallery"), ("GET", f"/gallery/{TAKE}/shown"), ("DELETE", f"/gallery/{TAKE}")):
                    async with client.request(method, address, headers=headers) as answer:
                        assert answer.status == status
            async with client.get("/state", headers=view) as answer:
                assert (await answer.json())["gallery"] is False
    assert (folder / TAKE).exists() and (folder / "private.mp4").exists() and (tmp_path / TAKE).exists()


async def test_before_anything_was_saved_the_list_is_empty(tmp_path: Path) -> None:
    gallery = Gallery(tmp_path / "not_there")
    async with made_viewfinder(gallery=gallery) as made, aiohttp.ClientSession() as client, client.get(made.url + "gallery") as answer:
        assert answer.status == 200 and (await answer.json())["saved"] == []
