// The ground that the object stands on: where a pixel meets it, and its grid drawn over the photograph.
import type { Photo, State } from "./studio_model";

const ACROSS = 5;
const WIDE = 40;
const DEEP = 50;
/** Least distance of two rows of the grid, in heights of the picture. */
const LEAST_APART = 0.008;
const EYES_M = 1.5;

type Point = [number, number];

/** A pinhole above level ground; pixels are those of the whole photograph. */
export class Ground {
  private readonly cos: number;
  private readonly sin: number;
  readonly high_m: number;

  constructor(private readonly photo: Photo, private readonly focal_px: number, state: State) {
    const pitch = state.plain ? 0 : ((state.pitch_deg ?? 0) * Math.PI) / 180;
    [this.cos, this.sin] = [Math.cos(pitch), Math.sin(pitch)];
    this.high_m = state.camera_height_m ?? EYES_M;
  }

  /** Row of the horizon. */
  get horizon_px(): number {
    return this.photo.height_px / 2 - (this.focal_px * this.sin) / this.cos;
  }

  /** Distance along the view of the ground under a pixel, null above the horizon. */
  distance_m(y_px: number): number | null {
    const falls = (this.cos * (y_px - this.photo.height_px / 2)) / this.focal_px + this.sin;
    return falls > 1e-6 ? this.high_m / falls : null;
  }

  /** The pixel, or the nearest below the horizon and within the photograph. */
  within([x, y]: Point): Point {
    const { width_px, height_px } = this.photo;
    const top = Math.max(0, this.horizon_px + 0.004 * height_px);
    return [Math.min(width_px - 1, Math.max(0, x)), Math.min(height_px - 1, Math.max(Math.min(top, height_px - 1), y))];
  }

  /** Distance ahead on the ground, level, of what the lowest row shows; null where it shows no ground. */
  private get nearest_m(): number | null {
    const y = this.photo.height_px / 2 / this.focal_px;
    const z_m = this.distance_m(this.photo.height_px);
    return z_m === null ? null : z_m * (this.cos - this.sin * y);
  }

  /** Side of a cell of the grid, metres: 1, 2 or 5 of a power of ten, about five of which fit into the lowest row. */
  get cell_m(): number {
    const z_m = this.distance_m(this.photo.height_px) ?? this.high_m;
    const wanted = (z_m * this.photo.width_px) / this.focal_px / ACROSS;
    const power = 10 ** Math.floor(Math.log10(wanted));
    return Number((power * (wanted / power >= 5 ? 5 : wanted / power >= 2 ? 2 : 1)).toPrecision(1));
  }

  /** The grid as the path of an SVG in pixels of the photograph. */
  grid(): string {
    const [cell, nearest_m] = [this.cell_m, this.nearest_m];
    if (nearest_m === null) return "";
    const lines: string[] = [];
    const first = Math.floor(nearest_m / cell) - 1;
    const cut_m = 0.02 * this.high_m;
    let last = first;
    // Rows that would run together are left out, and the lines along the view end with them.
    for (let row_px = Infinity; last <= first + DEEP; last++) {
      const [, y, z] = this.seen(0, last * cell);
      if (z > cut_m && row_px - y < LEAST_APART * this.photo.height_px) break;
      row_px = z > cut_m ? y : row_px;
      this.line(lines, [-WIDE * cell, last * cell], [WIDE * cell, last * cell], cut_m);
    }
    for (let i = -WIDE; i <= WIDE; i++) this.line(lines, [i * cell, first * cell], [i * cell, last * cell], cut_m);
    return lines.join("");
  }

  /** A circle on the ground about a pixel, as the path of an SVG. */
  circle([x_px, y_px]: Point, radius_m: number): string {
    const z_m = this.distance_m(y_px);
    if (z_m === null) return "";
    const x_m = ((x_px - this.photo.width_px / 2) / this.focal_px) * z_m;
    // From camera axes to upright ones.
    const ahead_m = -this.sin * (((y_px - this.photo.height_px / 2) / this.focal_px) * z_m) + this.cos * z_m;
    const points = Array.from({ length: 33 }, (_, i) => {
      const turn = (i / 32) * 2 * Math.PI;
      return this.seen(x_m + radius_m * Math.cos(turn), ahead_m + radius_m * Math.sin(turn));
    });
    if (points.some((each) => each[2] <= 0)) return "";
    return points.map(([x, y], i) => `${i ? "L" : "M"}${x.toFixed(1)} ${y.toFixed(1)}`).join("");
  }

  /** Pixel and depth of a point of the ground. */
  private seen(x_m: number, ahead_m: number): [number, number, number] {
    const y = this.cos * this.high_m - this.sin * ahead_m;
    const z = this.sin * this.high_m + this.cos * ahead_m;
    return [this.photo.width_px / 2 + (this.focal_px * x_m) / z, this.photo.height_px / 2 + (this.focal_px * y) / z, z];
  }

  private line(lines: string[], [x0, a0]: Point, [x1, a1]: Point, nearest_m: number): void {
    const z0 = this.sin * this.high_m + this.cos * a0;
    const z1 = this.sin * this.high_m + this.cos * a1;
    if (z0 < nearest_m && z1 < nearest_m) return;
    // Cut off what lies behind the camera.
    const cut = (x: number, a: number, z: number, x2: number, a2: number, z2: number): Point => {
      if (z >= nearest_m) return [x, a];
      const share = (nearest_m - z) / (z2 - z);
      return [x + share * (x2 - x), a + share * (a2 - a)];
    };
    const [p, q] = [this.seen(...cut(x0, a0, z0, x1, a1, z1)), this.seen(...cut(x1, a1, z1, x0, a0, z0))];
    lines.push(`M${p[0].toFixed(1)} ${p[1].toFixed(1)}L${q[0].toFixed(1)} ${q[1].toFixed(1)}`);
  }
}

/** The ground of a state; null where depth tells it, or nothing is known of the camera. */
export function groundOf(photo: Photo | null, state: State | null): Ground | null {
  return photo && state && photo.focal_px !== null && !photo.has_depth && !state.plain ? new Ground(photo, photo.focal_px, state) : null;
}
