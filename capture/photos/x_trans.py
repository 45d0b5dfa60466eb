"""X-Trans files decoded by a Python of their own with one thread: LibRaw's parallel decoding of them is not reproducible.

LibRaw issue 845: between 0.03 and 0.16 % of the samples of a compressed RAF differ from run to run, and its demosaicing of
X-Trans does too (1033 of 972 000 samples of an uncompressed DNG on two cores), unless OMP_NUM_THREADS=1 was set before
LibRaw was loaded, which only a new process can still do. It is spawned, never forked: OpenMP deadlocks in a forked child.
"""

import os
import pickle
import subprocess
import sys
import tempfile
from pathlib import Path

from capture.photos.decoded_photo import DecodedPhoto
from capture.photos.libraw import WhiteBalance
from mrbokeh.system.errors import InputError

X_TRANS_SIZE = (6, 6)
_VARIABLE = "OMP_NUM_THREADS"
_WORKER = "capture.photos.x_trans_worker"
# OpenMP reads it once: what is set later does not count.
_AT_START = os.environ.get(_VARIABLE)


def decodes_reproducibly() -> bool:
    """Whether this process was started with one OpenMP thread."""
    return _AT_START == "1"


def decode_in_one_thread(path: Path, white_balance: WhiteBalance | None, half_size: bool) -> DecodedPhoto:
    """`decode_raw` in a process of its own with one thread; errors come back as they were."""
    with tempfile.TemporaryDirectory(prefix="mrbokeh_") as folder:
        result = Path(folder) / "decoded.pickle"
        order = pickle.dumps((Path(path), white_balance, half_size, result))
        search = os.pathsep.join(each for each in sys.path if each)
        environment = os.environ | {_VARIABLE: "1", "PYTHONPATH": search}
        done = subprocess.run([sys.executable, "-m", _WORKER], input=order, env=environment, capture_output=True)
        if done.returncode != 0 or not result.is_file():
            last_line = (done.stderr.decode(errors="replace").strip().splitlines() or ["no message"])[-1]
            raise InputError(
                f"{path} cannot be decoded as RAW: the process that decodes X-Trans ended with {done.returncode} ({last_line})"
            )
        with result.open("rb") as file:
            answer = pickle.load(file)
    if isinstance(answer, InputError):
        raise answer
    assert isinstance(answer, DecodedPhoto)
    return answer
