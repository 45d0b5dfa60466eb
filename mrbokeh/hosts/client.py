"""Ask a running `mrbokeh serve` for blur. One file for Python 3.7 and later: standard library, and numpy where arrays are handed over."""

import http.client
import json
import os
import tempfile


class Refused(Exception):  # noqa: N818
    """A request that was not answered with a picture; the message is one sentence for the user."""


def connection_file() -> str:
    """Return where `mrbokeh serve` says by which port and token it is asked: $MRBOKEH_SERVER, or a file in the home folder."""
    return os.environ.get("MRBOKEH_SERVER") or os.path.join(os.path.expanduser("~"), ".mrbokeh-server.json")


def ask(request: dict, connection: str = "", longest_s: float = 3600.0) -> dict:
    """Send a request (docs/hosts.md) and return the answer when it is finished; an empty one asks whether the server is there.

    connection: the file that the server wrote, if not `connection_file()`. Raises Refused.
    """
    path = connection or connection_file()
    try:
        with open(path, encoding="utf-8") as file:
            server = json.load(file)
        port, token = int(server["port"]), str(server["token"])
    except (OSError, ValueError, KeyError, TypeError):
        raise Refused("no mrbokeh server is running (" + path + " does not name one): start `mrbokeh serve` in a terminal") from None
    body, headers = json.dumps(request).encode("utf-8"), {"Authorization": "Bearer " + token, "Content-Type": "application/json"}
    caller = http.client.HTTPConnection("127.0.0.1", port, timeout=longest_s)
    try:
        caller.request("POST", "/", body, headers)
        answer = json.loads(caller.getresponse().read().decode("utf-8"))
    except (OSError, ValueError, http.client.HTTPException):
        raise Refused("the mrbokeh server does not answer, or ended before it had: start `mrbokeh serve` again") from None
    finally:
        caller.close()
    if "error" in answer:
        raise Refused(answer["error"])
    return dict(answer)


def frame_request(values: dict, sharp: str, out: str) -> dict:
    """Return what is asked for one frame in files. values: focus, facts of the lens, lens and renderer; what is empty is left out."""
    given = {name: value for name, value in values.items() if value not in (None, "")}
    if str(given.get("lens", "")).lower().endswith(".onnx"):  # a network blurs as the lens that it learned
        given = {name: given[name] for name in ("focus", "lens") if name in given}
    return dict(given, what="render", picture=sharp, out=out, overwrite=True)


def blurred(picture, depth_m, **request):  # type: ignore[no-untyped-def]
    """Return the blurred picture and the answer. Arrays lie in shared memory, where there is a folder of it, and never on a disk there.

    picture: (H, W, 3) linear light; depth_m: (H, W) metres, inf where nothing is. request: lens, focus and so on.
    """
    import numpy as np

    files = []

    def shared(array):  # type: ignore[no-untyped-def]
        handle, path = tempfile.mkstemp(prefix="mrbokeh-", dir="/dev/shm" if os.path.isdir("/dev/shm") else None)
        files.append(path)
        with os.fdopen(handle, "wb") as file:
            np.ascontiguousarray(array, np.float32).tofile(file)
        return {"memory": path, "shape": list(array.shape), "dtype": "float32"}

    connection = request.pop("connection", "")
    try:
        # The result is written over the copy of the picture, which the server has read by then.
        given = shared(np.asarray(picture))
        answer = ask({"picture": given, "depth": shared(np.asarray(depth_m)), "out": {"memory": given["memory"]}, **request}, connection)
        return np.fromfile(given["memory"], np.float32).reshape(given["shape"]), answer
    finally:
        for path in files:
            os.unlink(path)
