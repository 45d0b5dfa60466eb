// Fingers on the picture: taps, drags and pinches, and what they zoom and move.
import { type Matrix3, model } from "./model";
import { control, pace, refreshState } from "./server";

// Fingers on the picture: a tap, a drag with one, a pinch with two.
export interface Gestures {
  tap(x_px: number, y_px: number): void;
  dragStart(x_px: number, y_px: number): void;
  drag(x_px: number, y_px: number, dx_px: number, dy_px: number): void;
  /** pinched: a second finger came, so that it was no drag. */
  dragEnd(pinched: boolean): void;
  /** factor: of the distance of the fingers since the last call, about the point between them, which moved by (dx, dy). turn_deg: clockwise. */
  pinch(factor: number, x_px: number, y_px: number, dx_px: number, dy_px: number, turn_deg: number): void;
  twice(x_px: number, y_px: number): void;
  /** A wheel; without this it pinches, and a level one turns. */
  wheel?(factor: number, turn_deg: number): void;
  /** The wheel with Ctrl or Cmd, as a trackpad's pinch is, and the middle button, which only moves; without this they pinch. */
  zoom?(factor: number, x_px: number, y_px: number, dx_px: number, dy_px: number): void;
}

const TAP_PX = 10;
const TWICE_MS = 300;

interface Finger {
  x: number;
  y: number;
}

/** Listen on an element whose touch-action is none. */
export function listen(element: HTMLElement, gestures: Gestures): void {
  const zoom = (factor: number, x: number, y: number, dx: number, dy: number): void => (gestures.zoom ? gestures.zoom(factor, x, y, dx, dy) : gestures.pinch(factor, x, y, dx, dy, 0));
  const fingers = new Map<number, Finger>();
  let start: Finger = { x: 0, y: 0 };
  let kind: "none" | "tap" | "drag" | "pinch" | "move" = "none";
  let lastTap_ms = -Infinity;

  element.addEventListener("pointerdown", (event) => {
    element.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    if (kind === "drag") gestures.dragEnd(true);
    start = { x: event.clientX, y: event.clientY };
    kind = fingers.size > 1 ? "pinch" : event.button === 1 ? "move" : "tap";
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
    } else if (kind === "move") {
      zoom(1, finger.x, finger.y, dx, dy);
    } else if (kind === "pinch" && fingers.size === 2) {
      const [a, b] = [...fingers.values()] as [Finger, Finger];
      const [c, d] = before as [Finger, Finger];
      const factor = Math.hypot(a.x - b.x, a.y - b.y) / Math.max(1, Math.hypot(c.x - d.x, c.y - d.y));
      const turned = Math.atan2(b.y - a.y, b.x - a.x) - Math.atan2(d.y - c.y, d.x - c.x);
      gestures.pinch(factor, (a.x + b.x) / 2, (a.y + b.y) / 2, dx / 2, dy / 2, (((turned * 180) / Math.PI + 540) % 360) - 180);
    }
  });

  const end = (event: PointerEvent): void => {
    if (!fingers.delete(event.pointerId)) return;
    if (kind === "drag") gestures.dragEnd(false);
    if (kind === "tap" && event.type === "pointerup") {
      if (event.timeStamp - lastTap_ms < TWICE_MS) gestures.twice(event.clientX, event.clientY);
      else gestures.tap(event.clientX, event.clientY);
      lastTap_ms = event.timeStamp;
    }
    if (kind !== "pinch" || fingers.size === 0) kind = "none";
  };
  element.addEventListener("pointerup", end);
  element.addEventListener("pointercancel", end);
  element.addEventListener("wheel", (event) => {
    event.preventDefault();
    const factor = Math.exp(-event.deltaY / 400);
    // A trackpad's pinch counts in small steps.
    if (event.ctrlKey || event.metaKey) zoom(Math.abs(event.deltaY) < 50 ? factor ** 4 : factor, event.clientX, event.clientY, 0, 0);
    else if (gestures.wheel) gestures.wheel(factor, event.deltaX / 8);
    else gestures.pinch(factor, event.clientX, event.clientY, 0, 0, event.deltaX / 8);
  }, { passive: false });
}

// Enlarges what is displayed, about the fingers; nothing of it reaches the server.
const MOST = 8;

export class Zoom {
  scale = 1;
  private left_px = 0;
  private top_px = 0;

  constructor(private readonly frame: HTMLElement, private readonly stage: HTMLElement) {}

  by(factor: number, x_px: number, y_px: number, dx_px: number, dy_px: number): void {
    const scale = Math.min(MOST, Math.max(1, this.scale * factor));
    const box = this.frame.getBoundingClientRect();
    const [x, y] = [x_px - box.left, y_px - box.top];
    // What lies under the fingers stays there.
    this.left_px = x - ((x - this.left_px) * scale) / this.scale + dx_px;
    this.top_px = y - ((y - this.top_px) * scale) / this.scale + dy_px;
    this.scale = scale;
    this.apply();
  }

  pan(dx_px: number, dy_px: number): void {
    this.left_px += dx_px;
    this.top_px += dy_px;
    this.apply();
  }

  reset(): void {
    [this.scale, this.left_px, this.top_px] = [1, 0, 0];
    this.apply();
  }

  private apply(): void {
    const { clientWidth, clientHeight } = this.stage;
    this.left_px = Math.min(0, Math.max(clientWidth * (1 - this.scale), this.left_px));
    this.top_px = Math.min(0, Math.max(clientHeight * (1 - this.scale), this.top_px));
    this.stage.style.transform = `translate(${this.left_px}px, ${this.top_px}px) scale(${this.scale})`;
  }
}

// Dragging an object on the plane on which it stands: from the finger to metres through the homography of the state.
type Point = [number, number];

/** A point of the picture (0 to 1, right and down) on the ground, metres; null beyond the horizon. */
export function onGround([m0, m1, m2]: Matrix3, [x, y]: Point): Point | null {
  const of = ([a, b, c]: [number, number, number]): number => a * x + b * y + c;
  const w = of(m2);
  return Math.abs(w) < 1e-9 ? null : [of(m0) / w, of(m1) / w];
}

/** One finger on one object. */
export class ObjectDrag {
  private ground: Matrix3 | null = null;
  private sent: Point | null = null;
  private wanted: Point | null = null;
  private busy = false;

  constructor(private readonly name: string, private readonly from: Point) {
    void this.begin();
  }

  moveTo(point: Point): void {
    this.wanted = point;
    void this.send();
  }

  /** The plane as it lies now: the camera may have moved since the last state. */
  private async begin(): Promise<void> {
    const state = await refreshState().catch(() => null);
    this.ground = state?.ground_from_picture ?? null;
    this.sent = this.ground && onGround(this.ground, this.from);
    if (!this.sent) model.say("an object can be moved while the camera is tracked and sees the ground", 6);
    void this.send();
  }

  private async send(): Promise<void> {
    if (this.busy || !this.ground) return;
    this.busy = true;
    while (this.wanted && this.sent) {
      const to = onGround(this.ground, this.wanted);
      this.wanted = null;
      if (!to) continue;
      const answer = await control({ object: { name: this.name, move_m: [to[0] - this.sent[0], to[1] - this.sent[1]] } });
      if (!answer) break;
      this.sent = to;
      await pace();
    }
    this.busy = false;
  }
}
