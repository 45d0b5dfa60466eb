// Dragging an object on the plane on which it stands: from the finger to metres through the homography of the state.
import { model, type Matrix3 } from "./model";
import { control, pace, refreshState } from "./server";

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
