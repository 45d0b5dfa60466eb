// Lines drawn along edges, by which the server solves the camera, one of known height, by which it finds its scale, and a shadow that is pointed at, by which it finds the sun.
import { byId, type DrawnLine, type Measured, type Pair, type State, type Told, inPhoto, studio } from "./studio_model";

const AXES = ["y", "x", "z", "h", "m"] as const;
/** A line of the page: one of an edge, or "m" along something of known height. */
type Line = [number, number, number, number, (typeof AXES)[number]];
/** There is one horizon, and one known height. */
const isOnly = (axis: Line[4]): boolean => axis === "h" || axis === "m";
/** How near an end is taken: of the chosen direction, and of others, as edges of several directions meet in corners. */
const NEAR = 16;
const ON_IT = 10;
const SHORTEST = 12;

export class Lines {
  private readonly drawn = byId<SVGSVGElement>("lines");
  private readonly metres = byId<HTMLInputElement>("metres");
  private axis: Line[4] = "y";
  private lines: Line[] | null = null;
  /** The end that is dragged: line, and 0 or 2 for its first coordinate. */
  private end: [number, 0 | 2] = [0, 2];

  constructor() {
    const button = byId<HTMLElement>("draw_lines");
    button.addEventListener("click", () => {
      button.setAttribute("aria-pressed", String(!this.on));
      studio.say(this.on ? "draw along the horizon where it is seen, or along edges: two of one direction, such as Upright, and one of another; drag an end to move it, tap the middle of a line to remove it" : "", this.on);
      this.draw();
    });
    for (const axis of AXES) {
      byId(`axis_${axis}`).addEventListener("click", () => {
        this.axis = axis;
        for (const each of AXES) byId(`axis_${each}`).setAttribute("aria-pressed", String(each === axis));
        if (axis === "m") studio.say("draw from the foot to the head of somebody, or of something upright, and type how high that is", true);
        this.draw();
        if (axis === "m") byId("metres_row").scrollIntoView({ block: "nearest", inline: "nearest" });
      });
    }
    byId("lines_clear").addEventListener("click", () => void studio.commit({ lines: [], measured: null }));
    this.metres.addEventListener("change", () => this.keep(this.known));
    for (const event of ["state", "view"]) studio.addEventListener(event, () => this.draw());
    studio.addEventListener("told", () => this.on && this.known.length && studio.say(this.said(), true));
  }

  /** All lines of the state. */
  private get known(): Line[] {
    const [lines, measured] = [studio.state?.lines ?? [], studio.state?.measured];
    return [...lines.map((each): Line => [...each]), ...(measured ? [[...measured.slice(0, 4), "m"] as Line] : [])];
  }

  /** What the lines tell. */
  private said(): string {
    const { lines, measured, camera_height_m } = studio.state!;
    const scale = measured && camera_height_m ? [`By the known height the camera stands ${Number(camera_height_m.toPrecision(3))} m above the ground.`] : [];
    return [...(lines.length ? [studio.told?.camera?.told ?? ""] : []), ...scale].join(" ");
  }

  /** Keep lines, of which one may be of known height. */
  private keep(lines: Line[]): void {
    const metres = this.metres.valueAsNumber;
    const known = lines.find((each) => each[4] === "m");
    if (known && !(metres > 0)) return studio.say("give how many metres high it is, above 0");
    const changes: Partial<State> = { lines: lines.filter((each): each is DrawnLine => each[4] !== "m"), measured: known ? ([...known.slice(0, 4), metres] as Measured) : null };
    const same = (name: "lines" | "measured"): boolean => JSON.stringify(changes[name]) === JSON.stringify(studio.state?.[name]);
    for (const name of ["lines", "measured"] as const) if (same(name)) delete changes[name];
    if (Object.keys(changes).length) void studio.commit(changes);
    else this.draw();
  }

  get on(): boolean {
    return byId<HTMLElement>("draw_lines").getAttribute("aria-pressed") === "true";
  }

  /** Take the near end of a line, or begin a new one. px: pixels of the photograph in one of the window. */
  start(at_px: Pair, px: number): void {
    this.lines = this.known;
    const reach = (axis: Line[4]): number => (axis === this.axis ? NEAR : ON_IT) * px;
    const ends = this.lines.flatMap((each, line) => ([0, 2] as const).map((i) => ({ line, i, away: Math.hypot(each[i] - at_px[0], each[i + 1 as 1 | 3] - at_px[1]) / reach(each[4]) })));
    const nearest = ends.sort((one, other) => one.away - other.away)[0];
    if (nearest && nearest.away < 1) this.end = [nearest.line, nearest.i];
    else this.end = [(this.lines = this.lines.filter((each) => each[4] !== this.axis || !isOnly(this.axis))).push([at_px[0], at_px[1], at_px[0], at_px[1], this.axis]) - 1, 2];
  }

  move(at_px: Pair): void {
    const line = this.lines?.[this.end[0]];
    if (!line) return;
    [line[this.end[1]], line[(this.end[1] + 1) as 1 | 3]] = inPhoto(at_px);
    this.draw();
  }

  /** pinched: the line became a pinch, and is forgotten. */
  stop(px: number, pinched: boolean): void {
    const lines = pinched ? undefined : this.lines?.filter((each) => Math.hypot(each[2] - each[0], each[3] - each[1]) > SHORTEST * px);
    this.lines = null;
    if (pinched) this.draw();
    if (lines) this.keep(lines);
  }

  /** Remove the line under a finger. */
  tap([x, y]: Pair, px: number): void {
    const lines = this.known;
    const away = ([x1, y1, x2, y2]: Line): number => {
      const along = Math.min(1, Math.max(0, ((x - x1) * (x2 - x1) + (y - y1) * (y2 - y1)) / Math.hypot(x2 - x1, y2 - y1) ** 2));
      return Math.hypot(x1 + along * (x2 - x1) - x, y1 + along * (y2 - y1) - y);
    };
    const nearest = [...lines].sort((one, other) => away(one) - away(other))[0];
    const isAtEnd = nearest && Math.min(Math.hypot(x - nearest[0], y - nearest[1]), Math.hypot(x - nearest[2], y - nearest[3])) < NEAR * px;
    if (nearest && !isAtEnd && away(nearest) < NEAR * px) this.keep(lines.filter((each) => each !== nearest));
  }

  private draw(): void {
    const photo = studio.told?.photo;
    const lines = this.lines ?? this.known;
    byId<HTMLElement>("lines_row").hidden = !this.on;
    byId<HTMLElement>("metres_row").hidden = this.axis !== "m";
    if (studio.state?.measured && document.activeElement !== this.metres) this.metres.value = String(studio.state.measured[4]);
    byId<HTMLButtonElement>("lines_clear").disabled = !lines.length;
    this.drawn.replaceChildren();
    if (!photo || !this.on) return;
    this.drawn.setAttribute("viewBox", `0 0 ${photo.width_px} ${photo.height_px}`);
    const size = photo.width_px / this.drawn.clientWidth;
    for (const [x1, y1, x2, y2, axis] of lines) this.drawn.append(drawnLine(this.drawn, [[x1, y1], [x2, y2]], axis, size));
  }
}

/** A line through points with a ring about each. size: pixels of the photograph in one of the window. */
function drawnLine(drawing: SVGElement, points: Pair[], kind: string, size: number): Element {
  const line = document.createElementNS(drawing.namespaceURI, "path");
  const ring = ([x, y]: Pair): string => `M${x - 5 * size} ${y}a${5 * size} ${5 * size} 0 1 0 ${10 * size} 0a${5 * size} ${5 * size} 0 1 0 ${-10 * size} 0`;
  line.setAttribute("d", points.map(([x, y], i) => `${i ? "L" : "M"}${x} ${y}`).join("") + points.map(ring).join(""));
  line.setAttribute("class", kind);
  line.setAttribute("vector-effect", "non-scaling-stroke");
  return line;
}

const POINTS = ["click the top of something that stands upright in the sun", "now its foot, on the ground below that top", "now the tip of its shadow on the ground"];

/** Three taps: the top and the foot of something upright, and the tip of its shadow. */
export class Shadow {
  private readonly button = byId<HTMLElement>("sun_by");
  private readonly drawn = byId<SVGSVGElement>("pointed");
  private points: Pair[] = [];
  private photo = "";

  constructor() {
    // Points on one photograph say nothing of the next.
    studio.addEventListener("told", () => {
      const photo = `${studio.told?.state.photo} ${studio.told?.state.slice}`;
      if (photo !== this.photo && this.on) this.button.click();
      this.photo = photo;
    });
    this.button.addEventListener("click", () => {
      this.button.setAttribute("aria-pressed", String(!this.on));
      this.begin();
      studio.say(this.on ? POINTS[0]! : "", this.on);
    });
  }

  get on(): boolean {
    return this.button.getAttribute("aria-pressed") === "true";
  }

  /** Take a point. px: pixels of the photograph in one of the window. */
  async tap(at_px: Pair, px: number): Promise<void> {
    if (this.points.length === POINTS.length) return;
    this.points.push(inPhoto(at_px));
    const photo = studio.told!.photo!;
    this.drawn.setAttribute("viewBox", `0 0 ${photo.width_px} ${photo.height_px}`);
    this.drawn.replaceChildren(drawnLine(this.drawn, this.points, "sun", px));
    if (this.points.length < POINTS.length) return studio.say(POINTS[this.points.length]!, true);
    await studio.commit();
    const told = (await studio.post("/sun", { points: this.points })) as (Told & { said: string }) | null;
    this.begin();
    if (!told) return;
    this.button.setAttribute("aria-pressed", "false");
    studio.take(told);
    studio.say(told.said);
  }

  private begin(): void {
    this.points = [];
    this.drawn.replaceChildren();
  }
}
