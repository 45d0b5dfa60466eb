"""The streams in a real Chromium: colours on the screen, the name of the picture on the screen, alpha for OBS."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import numpy as np
import pytest
from aiohttp import web

from datasets_scripts.gallery.pictures import Page, chromium_page
from mrbokeh.compositing.overlay import Overlay
from mrbokeh.video.color import code_from_linear
from tests.live.test_page_browser import IN_CHROMIUM
from tests.scenes.streaming_viewers import BARS, Feed, bars, output, serving_routes, streaming
from viewfinder.streaming.other_programs import AlphaStream, obs_routes
from viewfinder.streaming.whep import Whep

pytestmark = IN_CHROMIUM

PAGE = """<video autoplay muted playsinline></video><script>
const video = document.querySelector("video");
window.shown = []; window.messages = [];
const next = (_, picture) => { shown.push(picture.rtpTimestamp); video.requestVideoFrameCallback(next); };
video.requestVideoFrameCallback(next);
async function play() {
  window.peer = new RTCPeerConnection();
  const known = RTCRtpReceiver.getCapabilities("video").codecs.filter((codec) => ["video/CODEC", "video/rtx"].includes(codec.mimeType));
  peer.addTransceiver("video", { direction: "recvonly" }).setCodecPreferences(known);
  peer.createDataChannel("status", { ordered: false, maxRetransmits: 0 }).onmessage = (event) => messages.push(JSON.parse(event.data));
  peer.ontrack = (event) => { video.srcObject = new MediaStream([event.track]); };
  await peer.setLocalDescription();
  const answer = await fetch("whep", { method: "POST", headers: { "Content-Type": "application/sdp" }, body: peer.localDescription.sdp });
  await peer.setRemoteDescription({ type: "answer", sdp: await answer.text() });
}
play();
</script>"""
# The middles of eight columns of what an element shows, as [red, green, blue, alpha].
MIDDLES = """(() => { const shown = document.querySelector("ELEMENT"), copy = document.createElement("canvas");
  copy.width = WIDTH; copy.height = HEIGHT; const context = copy.getContext("2d"); context.drawImage(shown, 0, 0);
  return [...Array(8).keys()].map((i) => [...context.getImageData(Math.floor((i + 0.5) * WIDTH / 8), HEIGHT / 2, 1, 1).data]); })()"""


@asynccontextmanager
async def page_of(routes: list[web.RouteDef], whep: Whep, path: str, profile: Path) -> AsyncIterator[Page]:
    """A browser on a path of a server with these routes."""
    async with serving_routes(routes) as url:
        try:
            async with chromium_page(url + path, profile, size_px=(800, 600)) as page:
                yield page
        finally:
            await whep.close()


@pytest.mark.parametrize("codec", ["H264", "VP8"])
async def test_colours_are_right_on_the_screen_and_pictures_have_their_names(tmp_path: Path, codec: str) -> None:
    async def index(_request: web.Request) -> web.Response:
        return web.Response(text=PAGE.replace("CODEC", codec), content_type="text/html")

    # As large as HD, where browsers would take what is untagged for BT.709.
    with streaming() as stream, Feed(stream, lambda _: bars(1280, 720), 20.0):
        whep = Whep(stream)
        async with page_of([web.get("/", index), *whep.routes()], whep, "/", tmp_path) as page:
            await page.comes_true("window.shown && shown.length > 20 && messages.length > 20")
            seen = np.array(await page.value(MIDDLES.replace("ELEMENT", "video").replace("WIDTH", "1280").replace("HEIGHT", "720")))
            # Limited range and whole codes of luma and chroma cost up to 2 (BT.709 shown as 601 would cost 39).
            np.testing.assert_allclose(seen[:, 2::-1], BARS.astype(int), atol=3)
            named = await page.value("shown.filter((each) => messages.some((message) => message.rtp_timestamp === each)).length")
            assert named >= await page.value("shown.length") - 3
            assert set(stream.encoded) == {codec}


async def test_obs_gets_colour_and_alpha(tmp_path: Path) -> None:
    """Columns of the picture: nothing, an opaque surface of half the light, the same half covered, a glow without coverage."""
    width, height = 320, 180
    light = np.zeros((height, width, 3), np.float32)
    shines = np.ones((height, width), np.float32)
    light[:, 80:160], shines[:, 80:160] = [0.5, 0.25, 0.1], 0.0
    light[:, 160:240], shines[:, 160:240] = [0.25, 0.125, 0.05], 0.5
    light[:, 240:] = [0.2, 0.2, 0.2]
    surface = 255 * code_from_linear(np.array([0.5, 0.25, 0.1], np.float32), "srgb")
    glow = 255 * code_from_linear(np.float32([0.2] * 3), "srgb")
    # What OBS adds to the codes of the camera times (1 - alpha), and alpha.
    expected = np.array([[0, 0, 0, 0], [*surface, 255], [*(surface / 2), 127.5], [*glow, 0]])

    async def feed(alpha: AlphaStream) -> None:
        sequence = 0
        while True:
            if alpha.wants_frame:
                alpha.show(Overlay(0, 0, light, shines), output(np.zeros((height, width, 3), np.uint8), sequence))
                sequence += 1
            await asyncio.sleep(0.05)

    with streaming() as stream:
        alpha, whep = AlphaStream(stream, "srgb"), Whep(stream)
        feeding = asyncio.ensure_future(feed(alpha))
        async with page_of(obs_routes(whep), whep, "/obs", tmp_path) as page:
            await page.comes_true("document.querySelector('canvas')?.height === 180")
            # Straight from the drawing buffer, which is premultiplied; the row in the middle, first column of each quarter's middle.
            expression = """(() => { const gl = document.querySelector("canvas").getContext("webgl"), all = [];
              for (const x of [40, 120, 200, 280]) { const one = new Uint8Array(4);
                gl.readPixels(x, 90, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, one); all.push([...one]); } return all; })()"""
            await page.comes_true(f"{expression}[1][3] > 200")
            seen = np.array(await page.value(expression))
        feeding.cancel()
        alpha.close()
    np.testing.assert_allclose(seen, expected, atol=5)
    assert seen[0].tolist() == [0, 0, 0, 0]
    assert seen[1, 3] == 255
