"""Settings to start from."""

from collections.abc import Callable
from dataclasses import replace

from training.network_settings import NetworkSettings
from training.settings import TrainSettings


def demo_settings(minutes: float = 2.5) -> TrainSettings:
    """The preset of the demo: the gated form without tiles, which learns a lens in minutes on two cores."""
    network = NetworkSettings(
        form="gated",
        width=2,
        tile_px=0,
        overlap_px=0,
        signed_coc=True,
        activation="identity",
        initialisation="disc",
        kernels_per_colour=False,
    )
    return TrainSettings(
        network=network,
        minutes=minutes,
        epochs=None,
        learning_rate=0.02,
        batch=2,
        crop_px=128,
        sensor_white=1.0,
        ema_decay=0.97,
    )


def better_settings() -> TrainSettings:
    """Our improvements together, for hours on a GPU: the gated form, with kernels for each colour that change over the frame.

    It is signed and without range, so that headroom does not arise, and needs no tiles, so that it takes pictures of any size.
    """
    demo = demo_settings()
    network = replace(demo.network, field_position=True, field_bases=4, kernels_per_colour=True)
    return replace(demo, network=network, minutes=None, epochs=50, learning_rate=0.01, crop_px=256, ema_decay=0.99)


PRESETS: dict[str, Callable[[], TrainSettings]] = {"paper": TrainSettings, "demo": demo_settings, "better": better_settings}
