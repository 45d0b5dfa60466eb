"""Under which path of the site each camera that comes from a browser is sent."""

from collections.abc import Sequence

from aiohttp import web

from viewfinder.server.site import Part
from viewfinder.sources.browser_camera import BrowserCameraSource
from viewfinder.sources.frame_source import FrameSource
from viewfinder.tracking.phone_tracker import PhoneFrames

CAMERA_PAGE = "camera"


class SentTo:
    """A Part: a browser camera under another path than /whip."""

    def __init__(self, camera: BrowserCameraSource, path: str) -> None:
        self._camera, self._path = camera, path

    def routes(self) -> Sequence[web.AbstractRouteDef]:
        return self._camera.routes(self._path)

    async def close(self) -> None:
        await self._camera.close()


def browser_cameras(source: FrameSource, phone: PhoneFrames | None) -> dict[str, Part]:
    """By name: "whip" is the one to which the camera page sends; where both come from browsers the phone has /phone-whip."""
    cameras: dict[str, Part] = {"whip": source} if isinstance(source, BrowserCameraSource) else {}
    if isinstance(phone, BrowserCameraSource):
        if cameras:
            cameras["phone-whip"] = SentTo(phone, "/phone-whip")
        else:
            cameras["whip"] = phone
    return cameras
