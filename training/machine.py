"""What a number was measured on, in one line."""

import os
import platform
from pathlib import Path


def machine_line() -> str:
    """Processor, cores, the GPU where torch sees one, and versions."""
    import torch

    gpu = [torch.cuda.get_device_name(0)] if torch.cuda.is_available() else []
    parts = [_processor(), f"{os.cpu_count()} cores", *gpu, f"Python {platform.python_version()}", f"torch {torch.__version__}"]
    return ", ".join(parts)


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine())
