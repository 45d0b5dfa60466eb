"""Video files for tests: the same packets, to be shown another way up."""

from pathlib import Path

import av


def turned_clip(clip: Path, out: Path, turn_deg: int) -> Path:
    """A QuickTime file that says that its pictures are to be turned counter-clockwise, as phones write it."""
    with av.open(str(clip)) as source, av.open(str(out), "w") as target:
        stream = target.add_stream_from_template(source.streams.video[0])
        stream.set_display_rotation(turn_deg)
        for packet in source.demux(source.streams.video[0]):
            if packet.size:
                packet.stream = stream
                target.mux(packet)
    return out
