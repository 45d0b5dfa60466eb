"""What the command line calls what the library names with its unit: for messages, and for options that once had the longer name."""

FLAGS = {
    "focus_distance_m": "--focus",
    "focal_length_mm": "--focal-length",
    "sensor_width_mm": "--sensor-width",
    "sensor_height_mm": "--sensor-height",
    "image_width_px": "--image-width",
    "nearest_m": "--near",
    "farthest_m": "--far",
    "diameter_px": "--diameter",
    "motion_px": "--motion",
    "frame_rate": "--rate",
}


def flag(name: str) -> str:
    """The option that sets a parameter: `focus_distance_m` is --focus, and what FLAGS does not hold goes by its own name."""
    return FLAGS.get(name, spelled_out(name))


def spelled_out(name: str) -> str:
    """--focus-distance-m for `focus_distance_m`."""
    return "--" + name.replace("_", "-")
