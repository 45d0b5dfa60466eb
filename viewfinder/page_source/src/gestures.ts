// Fingers on the picture: a tap, a drag with one, a pinch with two.

export interface Gestures {
  tap(x_px: number, y_px: number): void;
  dragStart(x_px: number, y_px: number): void;
  drag(x_px: number, y_px: number, dx_px: number, dy_px: number): void;
  dragEnd(): void;
  /** factor: of the distance of the fingers since the last call, about the point between them, which moved by (dx, dy). */
  pinch(factor: number, x_px: number, y_px: number, dx_px: number, dy_px: number): void;
  twice(): void;
}

const TAP_PX = 10;
const TWICE_MS = 300;

interface Finger {
  x: number;
  y: number;
}

/** Listen on an element whose touch-action is none. A wheel pinches too. */
export function listen(element: HTMLElement, gestures: Gestures): void {
  const fingers = new Map<number, Finger>();
  let start: Finger = { x: 0, y: 0 };
  let kind: "none" | "tap" | "drag" | "pinch" = "none";
  let lastTap_ms = -Infinity;

  element.addEventListener("pointerdown", (event) => {
    element.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    if (kind === "drag") gestures.dragEnd();
    start = { x: event.clientX, y: event.clientY };
    kind = fingers.size === 1 ? "tap" : "pinch";
  });

  element.addEventListener("pointermove", (event) => {
    const finger = fingers.get(event.pointerId);
    if (!finger) return;
    const before = [...fingers.values()].map((each) => ({ ...each }));
    const [dx, dy] = [event.clientX - finger.x, event.clientY - finger.y];
    [finger.x, finger.y] = [event.clientX, event.clientY];
    if (kind === "tap" && Math.hypot(finger.x - start.x, finger.y - start.y) > TAP_PX) {
      kind = "drag";
      gestures.dragStart(start.x, start.y);
      gestures.drag(finger.x, finger.y, finger.x - start.x, finger.y - start.y);
    } else if (kind === "drag") {
      gestures.drag(finger.x, finger.y, dx, dy);
    } else if (kind === "pinch" && fingers.size === 2) {
      const [a, b] = [...fingers.values()] as [Finger, Finger];
      const [c, d] = before as [Finger, Finger];
      const factor = Math.hypot(a.x - b.x, a.y - b.y) / Math.max(1, Math.hypot(c.x - d.x, c.y - d.y));
      gestures.pinch(factor, (a.x + b.x) / 2, (a.y + b.y) / 2, dx / 2, dy / 2);
    }
  });

  const end = (event: PointerEvent): void => {
    if (!fingers.delete(event.pointerId)) return;
    if (kind === "drag") gestures.dragEnd();
    if (kind === "tap" && event.type === "pointerup") {
      if (event.timeStamp - lastTap_ms < TWICE_MS) gestures.twice();
      else gestures.tap(event.clientX, event.clientY);
      lastTap_ms = event.timeStamp;
    }
    if (kind !== "pinch" || fingers.size === 0) kind = "none";
  };
  element.addEventListener("pointerup", end);
  element.addEventListener("pointercancel", end);
  element.addEventListener("wheel", (event) => {
    event.preventDefault();
    gestures.pinch(Math.exp(-event.deltaY / 400), event.clientX, event.clientY, 0, 0);
  }, { passive: false });
}
