// The ground that the object stands on: where a pixel meets it, and its grid drawn over the photograph.
import type { Matrix3 } from "./model";
import type { Photo, State } from "./studio_model";

const ACROSS = 5;
const WIDE = 40;
const DEEP = 50;
const LEVELS = 4;
/** Least distance of two rows of the grid, in heights of the picture. */
const LEAST_APART = 0.008;
const EYES_M = 1.5;
const BELOW_DEG = 10;

type Point = [number, number];

/** The turn from camera axes to upright ones (x right, y down, z ahead) of a camera that looks down, and is turned clockwise. */
function lookingDown(pitch_deg: number, roll_deg: number): Matrix3 {
  const [cos, sin] = [Math.cos((pitch_deg * Math.PI) / 180), Math.sin((pitch_deg * Math.PI) / 180)];
  const [level, turned] = [Math.cos((roll_deg * Math.PI) / 180), Math.sin((roll_deg * Math.PI) / 180)];
  return [[level, -turned, 0], [cos * turned, cos * level, sin], [-sin * turned, -sin * level, cos]];
}

/** A pinhole above level ground; pixels are those of the whole photograph. */
export class Ground {
  private readonly turn: Matrix3;
  readonly high_m: number;

  constructor(private readonly photo: Photo, private readonly focal_px: number, state: State) {
    const isTold = state.pitch_deg !== null || state.roll_deg !== null || !photo.world_from_camera;
    this.turn = isTold ? lookingDown(state.pitch_deg ?? photo.pitch_deg ?? 0, state.roll_deg ?? photo.roll_deg ?? 0) : photo.world_from_camera!;
    this.high_m = state.camera_height_m ?? photo.camera_height_m ?? EYES_M;
  }

  /** The ray of a pixel, of length 1 along the view, in upright axes. */
  private ray([x_px, y_px]: Point): [number, number, number] {
    const seen = [(x_px - this.photo.width_px / 2) / this.focal_px, (y_px - this.photo.height_px / 2) / this.focal_px, 1];
    const along = (row: readonly number[]): number => row[0]! * seen[0]! + row[1]! * seen[1]! + row[2]! * seen[2]!;
    return [along(this.turn[0]), along(this.turn[1]), along(this.turn[2])];
  }

  /** Row of the horizon in a column. */
  horizon_px(x_px: number): number {
    const [right, down, ahead] = this.turn[1];
    const across = (x_px - this.photo.width_px / 2) / this.focal_px;
    return this.photo.height_px / 2 - (this.focal_px * (ahead + right * across)) / down;
  }

  /** Distance along the view of the ground under a pixel, null above the horizon. */
  distance_m(at_px: Point): number | null {
    const falls = this.ray(at_px)[1];
    return falls > 1e-6 ? this.high_m / falls : null;
  }

  /** Length of so many pixels across the view, on the ground under a pixel. */
  length_m(at_px: Point, pixels: number): number {
    return (pixels * (this.distance_m(at_px) ?? 0)) / this.focal_px;
  }

  /** The pixel, or the nearest below the horizon and within the photograph. */
  within([x, y]: Point): Point {
    const { width_px, height_px } = this.photo;
    const column = Math.min(width_px - 1, Math.max(0, x));
    const top = Math.max(0, this.horizon_px(column) + 0.004 * height_px);
    return [column, Math.min(height_px - 1, Math.max(Math.min(top, height_px - 1), y))];
  }

  /** Middle of the lowest row. */
  private get lowest_px(): Point {
    return [this.photo.width_px / 2, this.photo.height_px];
  }

  /** Distance ahead on the ground, level, of what the lowest row shows; null where it shows no ground. */
  private get nearest_m(): number | null {
    const z_m = this.distance_m(this.lowest_px);
    return z_m === null ? null : z_m * this.ray(this.lowest_px)[2];
  }

  /** Whether the picture shows ground at all. */
  get isInSight(): boolean {
    return this.distance_m(this.lowest_px) !== null && this.horizon_px(this.photo.width_px / 2) < 0.97 * this.photo.height_px;
  }

  /** How far a camera looks down, in degrees, for which the ground at a pixel lies as deep below the horizon as it usually does. */
  usualTilt_deg([, y_px]: Point): number {
    const below_deg = (Math.atan((y_px - this.photo.height_px / 2) / this.focal_px) * 180) / Math.PI;
    return Number(Math.max(0, BELOW_DEG - below_deg).toFixed(1));
  }

  /** Side of a cell of the grid, metres: 1, 2 or 5 of a power of ten, about five of which fit into the lowest row. */
  get cell_m(): number {
    const z_m = this.distance_m(this.lowest_px) ?? this.high_m;
    const wanted = (z_m * this.photo.width_px) / this.focal_px / ACROSS;
    const power = 10 ** Math.floor(Math.log10(wanted));
    return Number((power * (wanted / power >= 5 ? 5 : wanted / power >= 2 ? 2 : 1)).toPrecision(1));
  }

  /** The grid as the path of an SVG in pixels of the photograph. */
  grid(): string {
    const [cell, nearest_m] = [this.cell_m, this.nearest_m];
    if (nearest_m === null) return "";
    const lines: string[] = [];
    const cut_m = 0.02 * this.high_m;
    let [first, row_px] = [Math.floor(nearest_m / cell) - 1, Infinity];
    // Where rows would run together, squares of five times the side go on, and lines along the view end with theirs.
    for (let side = cell, level = 0; level < LEVELS; side *= 5, level++) {
      let last = first;
      for (; last <= first + DEEP; last++) {
        const [, y, z] = this.seen(0, last * side);
        if (z > cut_m && row_px - y < LEAST_APART * this.photo.height_px) break;
        row_px = z > cut_m ? y : row_px;
        this.line(lines, [-WIDE * side, last * side], [WIDE * side, last * side], cut_m);
      }
      for (let i = -WIDE; i <= WIDE; i++) this.line(lines, [i * side, first * side], [i * side, last * side], cut_m);
      first = Math.ceil(last / 5);
    }
    return lines.join("");
  }

  /** A circle on the ground about a pixel, as the path of an SVG. */
  circle(at_px: Point, radius_m: number): string {
    const z_m = this.distance_m(at_px);
    if (z_m === null) return "";
    const [x, , ahead] = this.ray(at_px);
    const points = Array.from({ length: 33 }, (_, i) => {
      const turn = (i / 32) * 2 * Math.PI;
      return this.seen(x * z_m + radius_m * Math.cos(turn), ahead * z_m + radius_m * Math.sin(turn));
    });
    if (points.some((each) => each[2] <= 0)) return "";
    return points.map(([across, down], i) => `${i ? "L" : "M"}${across.toFixed(1)} ${down.toFixed(1)}`).join("");
  }

  /** Pixel and depth of a point of the ground. */
  private seen(x_m: number, ahead_m: number): [number, number, number] {
    const z = this.depth(x_m, ahead_m);
    const column = (i: 0 | 1): number => this.turn[0][i] * x_m + this.turn[1][i] * this.high_m + this.turn[2][i] * ahead_m;
    return [this.photo.width_px / 2 + (this.focal_px * column(0)) / z, this.photo.height_px / 2 + (this.focal_px * column(1)) / z, z];
  }

  private depth(x_m: number, ahead_m: number): number {
    return this.turn[0][2] * x_m + this.turn[1][2] * this.high_m + this.turn[2][2] * ahead_m;
  }

  private line(lines: string[], [x0, a0]: Point, [x1, a1]: Point, nearest_m: number): void {
    const [z0, z1] = [this.depth(x0, a0), this.depth(x1, a1)];
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
