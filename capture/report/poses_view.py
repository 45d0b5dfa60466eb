"""Cameras and points in 3D: a canvas that is turned by mouse or finger, without any library."""

import json
from typing import Any

import numpy as np

from capture.poses.sparse_model import SparseModel, SparseView

MOST_POINTS = 4000
_CORNERS = ((0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0))


def poses_view(model: SparseModel) -> str:
    """HTML of the view. Lengths are in metres where the scale is known, else in the model's unit."""
    data = json.dumps(scene_of(model), separators=(",", ":")).replace("</", "<\\/")
    return (
        f'<canvas id="poses" width="900" height="520" style="touch-action:none;background:#14171c;border-radius:6px"></canvas>'
        f'<p class="muted">Drag to turn, wheel or two fingers to zoom, double click to start over.</p>'
        f'<script type="application/json" id="poses-data">{data}</script><script>{_SCRIPT}</script>'
    )


def scene_of(model: SparseModel) -> dict[str, Any]:
    """What the canvas draws, about the median point: cameras as a centre and four corners of the picture, and some of the points."""
    model = model.scaled() if model.metres_per_unit is not None else model
    centres = np.array([each.centre for each in model.views]).reshape(-1, 3)
    points = (
        model.points[np.linspace(0, len(model.points) - 1, min(len(model.points), MOST_POINTS)).astype(int)]
        if len(model.points)
        else model.points
    )
    everything = np.concatenate([centres, points])
    middle = np.median(everything, axis=0) if len(everything) else np.zeros(3)
    reach = float(np.percentile(np.linalg.norm(everything - middle, axis=1), 90)) if len(everything) else 1.0
    size = 0.12 * max(reach, 1e-9)
    return {
        "unit": "m" if model.metres_per_unit is not None else "units",
        "reach": max(reach, 1e-9),
        "cameras": [_camera(each, middle, size) for each in model.views],
        "points": np.round((points - middle) / max(reach, 1e-9), 4).ravel().tolist(),
    }


def _camera(view: SparseView, middle: np.ndarray, size: float) -> dict[str, Any]:
    camera = view.camera
    corners_px = np.array(_CORNERS) * [camera.width_px, camera.height_px]
    corners = camera.unproject(corners_px, np.full(4, size))
    return {"name": view.name, "centre": (view.centre - middle).tolist(), "corners": (corners - middle).tolist()}


_SCRIPT = """
(() => {
  const data = JSON.parse(document.getElementById('poses-data').textContent), canvas = document.getElementById('poses');
  const context = canvas.getContext('2d'), fingers = new Map();
  let yaw = 0.5, pitch = -0.35, zoom = 1, pinch = 0;
  const turned = ([x, y, z]) => {
    const a = Math.cos(yaw) * x + Math.sin(yaw) * z, b = -Math.sin(yaw) * x + Math.cos(yaw) * z;
    return [a, Math.cos(pitch) * y - Math.sin(pitch) * b, Math.sin(pitch) * y + Math.cos(pitch) * b];
  };
  const onScreen = p => {
    const [x, y, z] = turned(p), scale = 0.36 * canvas.height * zoom * 3 / (3 + z);
    return [canvas.width / 2 + x * scale, canvas.height / 2 + y * scale, z];
  };
  const scaled = p => p.map(v => v / data.reach);
  const line = (a, b) => { context.beginPath(); context.moveTo(a[0], a[1]); context.lineTo(b[0], b[1]); context.stroke(); };
  function draw() {
    context.clearRect(0, 0, canvas.width, canvas.height);
    for (let i = 0; i < data.points.length; i += 3) {
      const [x, y, z] = onScreen(data.points.slice(i, i + 3)), light = Math.round(190 - 50 * Math.max(-1, Math.min(1, z)));
      context.fillStyle = `rgb(${light},${light},${light})`; context.fillRect(x, y, 1.5, 1.5);
    }
    context.strokeStyle = '#ffb347'; context.fillStyle = '#ffd9a0'; context.font = '13px system-ui, sans-serif';
    for (const camera of data.cameras) {
      const centre = onScreen(scaled(camera.centre)), corners = camera.corners.map(c => onScreen(scaled(c)));
      corners.forEach((corner, i) => { line(centre, corner); line(corner, corners[(i + 1) % 4]); });
      context.fillText(camera.name, centre[0] + 5, centre[1] - 5);
    }
    const length = 10 ** Math.floor(Math.log10(data.reach)), pixels = 0.36 * canvas.height * zoom * length / data.reach;
    context.strokeStyle = context.fillStyle = '#8fd3ff'; line([20, canvas.height - 20], [20 + pixels, canvas.height - 20]);
    context.fillText(`${+length.toPrecision(3)} ${data.unit}`, 20, canvas.height - 28);
  }
  canvas.addEventListener('pointerdown', e => {
    canvas.setPointerCapture(e.pointerId); fingers.set(e.pointerId, [e.clientX, e.clientY]); pinch = 0;
  });
  canvas.addEventListener('pointermove', e => {
    if (!fingers.has(e.pointerId)) return;
    const [x, y] = fingers.get(e.pointerId); fingers.set(e.pointerId, [e.clientX, e.clientY]);
    if (fingers.size === 1) {
      yaw += (e.clientX - x) * 0.008; pitch = Math.max(-1.6, Math.min(1.6, pitch - (e.clientY - y) * 0.008));
    } else {
      const [a, b] = [...fingers.values()], apart = Math.hypot(a[0] - b[0], a[1] - b[1]);
      if (pinch) zoom *= apart / pinch;
      pinch = apart;
    }
    draw();
  });
  for (const end of ['pointerup', 'pointercancel']) canvas.addEventListener(end, e => { fingers.delete(e.pointerId); pinch = 0; });
  canvas.addEventListener('wheel', e => { e.preventDefault(); zoom *= Math.exp(-e.deltaY * 0.001); draw(); }, { passive: false });
  canvas.addEventListener('dblclick', () => { yaw = 0.5; pitch = -0.35; zoom = 1; draw(); });
  draw();
})();
"""
