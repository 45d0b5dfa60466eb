// <vf-picture>: the picture, what is drawn over it, and what fingers do on it.
import { aids, askForLevel, showLevel } from "./aids";
import { listen, ObjectDrag, Zoom } from "./gestures";
import { Histogram, Marks, MatteFeed, sizeOf } from "./marks";
import { distanceText, model, type Remark } from "./model";
import { selection } from "./panel";
import { control } from "./server";

const THIRDS = [1, 2].flatMap((i) => [`M${i} 0V3`, `M0 ${i}H3`]).join("");

export class PictureView extends HTMLElement {
  private zoom!: Zoom;
  private stage!: HTMLElement;
  private marks: Marks | null = null;
  private histogram!: Histogram;
  private readonly matte = new MatteFeed((bitmap) => this.marks?.setMatte(bitmap));
  private moving: ObjectDrag | null = null;

  connectedCallback(): void {
    this.innerHTML = `<div id="stage">
      <canvas id="picture" role="img" aria-label="camera picture with the virtual object"></canvas>
      <video id="video" muted playsinline autoplay hidden aria-label="camera picture with the virtual object"></video>
      <canvas id="marks"></canvas>
      <svg id="grid" viewBox="0 0 3 3" preserveAspectRatio="none" hidden><path d="${THIRDS}"/></svg>
      <div id="level" hidden></div>
      <output id="spot" hidden></output>
    </div>
    <canvas id="histogram" width="128" height="48" hidden aria-label="histogram"></canvas>
    <span id="tracking" hidden></span>
    <p id="remark" role="status" hidden></p>
    <svg id="arrow" viewBox="-12 -12 24 24" hidden aria-hidden="true"><path d="M-9 -5H1V-10L11 0L1 10V5H-9Z"/></svg>
    <p id="message" role="status">connecting</p>`;
    this.stage = this.find("stage");
    this.zoom = new Zoom(this, this.stage);
    this.marks = Marks.on(this.find("marks"));
    this.histogram = new Histogram(this.find("histogram"));
    showLevel(this.find("level"), () => aids.has("level"));
    listen(this, this.gestures());
    model.addEventListener("frame", () => this.onFrame());
    model.addEventListener("state", () => this.showRemark(model.state?.remark ?? null));
    model.addEventListener("sentence", () => (this.find("message").textContent = model.sentence));
    aids.addEventListener("change", () => this.onAids());
    this.onAids();
  }

  find<T extends Element = HTMLElement>(id: string): T {
    return this.querySelector<T>(`#${id}`)!;
  }

  private gestures(): Parameters<typeof listen>[1] {
    return {
      tap: (x, y) => void this.focusAt(x, y),
      twice: () => this.zoom.reset(),
      dragStart: (x, y) => (this.moving = selection.name && model.mayControl ? new ObjectDrag(selection.name, this.inPicture(x, y)) : null),
      drag: (x, y, dx, dy) => (this.moving ? this.moving.moveTo(this.inPicture(x, y)) : this.zoom.pan(dx, dy)),
      dragEnd: () => (this.moving = null),
      pinch: (factor, x, y, dx, dy) => this.zoom.by(factor, x, y, dx, dy),
    };
  }

  /** 0 to 1 right and down, however the picture is zoomed. */
  private inPicture(x_px: number, y_px: number): [number, number] {
    const box = this.stage.getBoundingClientRect();
    return [(x_px - box.left) / box.width, (y_px - box.top) / box.height];
  }

  private async focusAt(x_px: number, y_px: number): Promise<void> {
    const at = this.inPicture(x_px, y_px);
    if (!model.mayControl || at.some((each) => each < 0 || each > 1)) return;
    const spot = this.find<HTMLOutputElement>("spot");
    [spot.style.left, spot.style.top] = [`${100 * at[0]}%`, `${100 * at[1]}%`];
    spot.textContent = "";
    spot.hidden = false;
    const answer = await control({ focus: { at } });
    if (answer) spot.textContent = distanceText(answer["focus_distance_m"] as number | null);
    setTimeout(() => (spot.hidden = true), answer ? 2500 : 500);
  }

  private onFrame(): void {
    const { pixels, header } = model.shown!;
    const [width, height] = sizeOf(pixels);
    if (width && height) this.style.setProperty("--aspect", `${width / height}`);
    if (this.marks && this.marking) {
      this.marks.draw(pixels, { peakReal: aids.has("peakReal"), peakVirtual: aids.has("peakVirtual"), zebra: aids.has("zebra") });
      if (aids.has("histogram")) this.histogram.draw(this.marks);
    }
    if (!header) return;
    this.showTracking(header.tracking ?? null, header.tracking_unsure === true);
    this.showRemark(header.remark ?? null);
  }

  /** A sentence at the top, and an arrow near the edge where the object went out of the picture. */
  private showRemark(remark: Remark | null): void {
    const line = this.find("remark");
    const arrow = this.find<SVGElement>("arrow");
    line.hidden = remark === null;
    arrow.toggleAttribute("hidden", !remark?.arrow);
    if (remark !== null && line.textContent !== remark.sentence) line.textContent = remark.sentence;
    if (!remark?.arrow) return;
    const [right, down] = remark.arrow;
    line.classList.toggle("low", down < 0);
    // On the rim of a box of 84 % of the picture, where a ray from its middle meets it.
    const reach = 42 / Math.max(Math.abs(right), Math.abs(down));
    [arrow.style.left, arrow.style.top] = [`${50 + reach * right}%`, `${50 + reach * down}%`];
    arrow.style.transform = `translate(-50%, -50%) rotate(${Math.atan2(down, right)}rad)`;
  }

  private get marking(): boolean {
    return (["peakReal", "peakVirtual", "zebra", "histogram"] as const).some((aid) => aids.has(aid));
  }

  private onAids(): void {
    this.find<SVGElement>("grid").toggleAttribute("hidden", !aids.has("grid"));
    this.find("histogram").hidden = !aids.has("histogram");
    if (!aids.has("level")) this.find("level").hidden = true;
    else void askForLevel();
    if (!this.marks && this.marking) model.say("this browser has no WebGL2, without which nothing can be marked", 6);
    if (!this.marking) this.marks?.clear();
    this.matte.run(aids.has("peakReal") || aids.has("peakVirtual"));
  }

  private showTracking(quality: number | null, unsure: boolean): void {
    const badge = this.find("tracking");
    badge.hidden = quality === null;
    if (quality === null) return;
    badge.dataset["quality"] = quality === 0 ? "lost" : unsure ? "unsure" : quality < 0.5 ? "weak" : "good";
    badge.textContent = quality === 0 ? "tracking lost" : unsure ? "tilt unsure: go nearer" : `tracking ${(100 * quality).toFixed(0)} %`;
  }
}
