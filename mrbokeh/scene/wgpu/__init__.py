"""The backend for graphics cards, by WebGPU."""
