// The brush: strokes over what stands in front of the objects; the server moves their edges to those of the picture.
import { byId, inPhoto, type Pair, studio } from "./studio_model";

const MOST_POINTS = 2000;

export class Brush {
  private readonly size = byId<HTMLInputElement>("brush_size");
  private readonly drawn = byId<SVGSVGElement>("stroke");
  private readonly tint = byId<HTMLImageElement>("matte");
  private points: Pair[] = [];
  private waiting = 0;

  constructor() {
    const button = byId<HTMLElement>("brush");
    button.addEventListener("click", () => {
      button.setAttribute("aria-pressed", String(!this.on));
      byId("brush_behind").setAttribute("aria-pressed", "false");
      studio.say(this.on ? "paint over what is in front of the object: the edge snaps to the picture's" : "", this.on);
      this.show();
    });
    const behind = byId<HTMLElement>("brush_behind");
    behind.addEventListener("click", () => behind.setAttribute("aria-pressed", String(behind.getAttribute("aria-pressed") !== "true")));
    const hide = byId("brush_hide");
    const hidden = (on: boolean): void => {
      hide.setAttribute("aria-pressed", String(on));
      byId<HTMLElement>("before").hidden = !on;
      studio.dispatchEvent(new Event("before"));
    };
    hide.addEventListener("click", () => hidden(hide.getAttribute("aria-pressed") !== "true"));
    button.addEventListener("click", () => hidden(false));
    byId("brush_clear").addEventListener("click", () => void studio.commit({ matte: null }));
    const stage = byId<HTMLElement>("stage");
    stage.addEventListener("pointerleave", () => this.points.length || this.drawn.replaceChildren());
    studio.addEventListener("state", () => this.show());
  }

  get on(): boolean {
    return byId<HTMLElement>("brush").getAttribute("aria-pressed") === "true";
  }

  private get radius_px(): number {
    return (this.size.valueAsNumber / 1000) * (studio.told?.photo?.width_px ?? 1000);
  }

  /** Show the brush's settings, and what it has told so far. */
  private show(): void {
    const matte = studio.state?.matte ?? null;
    byId<HTMLElement>("stage").classList.toggle("painting", this.on);
    byId<HTMLElement>("brush_row").hidden = !this.on;
    byId<HTMLButtonElement>("brush_clear").disabled = !matte;
    this.tint.hidden = !this.on || !matte;
    if (!this.on) this.drop();
    const source = `/matte?of=${encodeURIComponent(matte ?? "")}`;
    if (matte && this.on && this.tint.getAttribute("src") !== source) this.tint.src = source;
  }

  /** A wheel or two fingers change the brush's size. */
  scale(factor: number): void {
    this.size.valueAsNumber *= factor;
  }

  start(at_px: Pair): void {
    this.points = [at_px];
    this.draw();
  }

  move(at_px: Pair): void {
    const last = this.points.at(-1);
    if (!last || Math.hypot(at_px[0] - last[0], at_px[1] - last[1]) < this.radius_px / 6 || this.points.length >= MOST_POINTS) return;
    this.points.push(at_px);
    this.draw();
  }

  /** The ring of the brush under a pointer that only hovers. */
  hover(at_px: Pair): void {
    if (this.points.length || this.waiting) return;
    this.points = [at_px];
    this.draw();
    this.points = [];
  }

  /** Forget a stroke that became a pinch. */
  drop(): void {
    this.points = [];
    this.drawn.replaceChildren();
  }

  async end(): Promise<void> {
    const points = this.points.map(inPhoto);
    const front = byId<HTMLElement>("brush_behind").getAttribute("aria-pressed") !== "true";
    this.points = [];
    this.waiting++;
    await studio.commit();
    studio.say("finding the edge ...", true);
    const told = await studio.post("/paint", { points, radius: Math.max(1, this.radius_px), front });
    if (told) studio.take(told);
    if (--this.waiting) return;
    this.drawn.replaceChildren();
    if (told) studio.say("");
  }

  private draw(): void {
    const photo = studio.told?.photo;
    if (!photo) return;
    this.drawn.setAttribute("viewBox", `0 0 ${photo.width_px} ${photo.height_px}`);
    const line = document.createElementNS(this.drawn.namespaceURI, "path");
    const data = this.points.map(([x, y], i) => `${i ? "L" : "M"}${x.toFixed(1)} ${y.toFixed(1)}`).join("");
    line.setAttribute("d", this.points.length > 1 ? data : `${data}l0.01 0`);
    line.setAttribute("stroke-width", String(2 * this.radius_px));
    this.drawn.replaceChildren(line);
  }
}
