// The picture with the ground over it, and everything that hands do on it.
import { listen } from "./gestures";
import { Brush } from "./studio_brush";
import { Lines, Shadow } from "./studio_lines";
import { groundOf } from "./studio_ground";
import { type Box, byId, type Pair, scaledHeight, studio } from "./studio_model";
import { Loupe, View } from "./studio_view";

const NUDGES_REST_MS = 500;
const DRAWN_AGAIN_MS = 900;
/** So far beside its box a mouse, and two fingers, still take the object. */
const BESIDE_PX = 12;
const FINGERS_BESIDE_PX = 48;

/** Degrees from -180 to 180. */
export const within180 = (turn_deg: number): number => ((((turn_deg + 180) % 360) + 360) % 360) - 180;

export class PictureStage {
  private readonly stage = byId<HTMLElement>("stage");
  private readonly picture = byId<HTMLCanvasElement>("picture");
  private readonly before = byId<HTMLImageElement>("before");
  private readonly ground = byId<SVGSVGElement>("ground");
  private readonly view = new View();
  private readonly loupe = new Loupe();
  private readonly brush = new Brush();
  private readonly lines = new Lines();
  private readonly shadow = new Shadow();
  private photoName = "";
  private hint = "";
  private from: Pair | null = null;
  private moved: Pair = [0, 0];
  private panning = false;
  /** Whether the fingers that are down shape the object; null before they pinch. */
  private shaping: boolean | null = null;
  private later: ReturnType<typeof setTimeout> | undefined;
  private quiet: ReturnType<typeof setTimeout> | undefined;

  constructor() {
    new ResizeObserver(() => this.fit()).observe(byId("room"));
    studio.addEventListener("told", () => this.fit());
    studio.addEventListener("state", () => this.mark());
    studio.addEventListener("view", () => this.mark());
    studio.addEventListener("picture", (event) => this.show((event as CustomEvent<ImageBitmap>).detail));
    this.gestures();
    this.keys();
    this.buttons();
  }

  /** Lay the picture out in the window, and load the photograph when it is another one. */
  private fit(): void {
    const photo = studio.told?.photo ?? null;
    this.stage.hidden = !photo;
    byId<HTMLElement>("welcome").hidden = Boolean(photo);
    if (!photo) return;
    const of = `${photo.name} ${studio.told?.state.photo} ${photo.width_px}`;
    const name = `${of} ${photo.slice ?? ""}`;
    if (name !== this.photoName) {
      // Slices of one stack are compared at the same place.
      if (this.photoName.startsWith(`${of} `)) this.view.lookAnew();
      else this.view.reset();
      this.photoName = name;
      this.hint = "";
      this.before.src = `/photo?of=${encodeURIComponent(name)}`;
      this.before.decode().then(() => studio.isComplete || this.showPhotograph()).catch(() => undefined);
    }
    this.view.fit();
  }

  /** What is to be done next, or what the studio does. */
  private next(): string {
    const [told, state] = [studio.told, studio.state];
    if (told?.busy) return `${told.busy} ...`;
    if (this.hint) return this.hint;
    if (!told?.photo || !state) return "";
    return state.object ? (state.at_px ? "" : "Click where the object is to stand") : "Choose an object, or drop a GLB file";
  }

  private showPhotograph(): void {
    this.picture.width = this.before.naturalWidth;
    this.picture.height = this.before.naturalHeight;
    this.picture.getContext("2d")!.drawImage(this.before, 0, 0);
  }

  private show(bitmap: ImageBitmap): void {
    this.picture.width = bitmap.width;
    this.picture.height = bitmap.height;
    this.picture.getContext("2d")!.drawImage(bitmap, 0, 0);
    bitmap.close();
    this.mark();
  }

  /** Draw grid, horizon, the object's foot and its box. */
  private mark(): void {
    const [photo, state] = [studio.told?.photo ?? null, studio.state];
    const ground = groundOf(photo, state);
    const wanted = byId<HTMLElement>("grid").getAttribute("aria-pressed") === "true";
    this.stage.classList.toggle("placed", Boolean(state?.at_px));
    const badge = byId<HTMLElement>("badge");
    badge.textContent = this.next();
    badge.hidden = !badge.textContent;
    this.ground.replaceChildren();
    if (photo) this.ground.setAttribute("viewBox", `0 0 ${photo.width_px} ${photo.height_px}`);
    if (photo && ground && state && wanted) {
      this.path("", ground.grid());
      this.path("horizon", `M0 ${ground.horizon_px(0)}L${photo.width_px} ${ground.horizon_px(photo.width_px)}`);
      studio.objects.forEach((each, number) => {
        const box = this.boxOf(number);
        const radius_m = box ? ground.length_m(each.at_px, 0.5 * (box[2] - box[0]) * photo.width_px) : ground.cell_m / 2;
        this.path(number === state.before.length ? "foot" : "foot other", ground.circle(each.at_px, radius_m));
      });
      const seen = studio.isChanging ? [] : studio.told?.clip?.path_px ?? [];
      if (seen.length) this.path("track", seen.map(([x, y], i) => `${i ? "L" : "M"}${x} ${y}`).join(""));
      const [left, , right, bottom] = this.view.inSight;
      this.words(`one square: ${ground.cell_m} m`, left + 0.015 * (right - left), bottom - 0.015 * (right - left), this.px);
    }
    if (photo && !studio.isComplete && this.before.complete && this.before.naturalWidth) this.showPhotograph();
    const box = byId<HTMLElement>("box");
    const sides = studio.isComplete ? this.boxOf(state!.before.length) : null;
    box.hidden = !sides;
    if (sides) {
      const [left, top, right, bottom] = sides.map((each) => 100 * each) as [number, number, number, number];
      Object.assign(box.style, { left: `${left}%`, top: `${top}%`, width: `${right - left}%`, height: `${bottom - top}%` });
    }
    this.stage.classList.remove("resting");
    clearTimeout(this.quiet);
    this.quiet = setTimeout(() => this.stage.classList.add("resting"), DRAWN_AGAIN_MS);
  }

  private path(kind: string, data: string): void {
    const path = document.createElementNS(this.ground.namespaceURI, "path");
    path.setAttribute("d", data);
    path.setAttribute("vector-effect", "non-scaling-stroke");
    if (kind) path.setAttribute("class", kind);
    this.ground.append(path);
  }

  private words(text: string, x: number, y: number, scale: number): void {
    const words = document.createElementNS(this.ground.namespaceURI, "text");
    words.textContent = text;
    words.setAttribute("transform", `translate(${x} ${y}) scale(${scale})`);
    this.ground.append(words);
  }

  /** The pixel of the photograph under a point of the window. */
  private pixel(x: number, y: number): Pair {
    const box = this.stage.getBoundingClientRect();
    const photo = studio.told!.photo!;
    return [((x - box.left) / box.width) * photo.width_px, ((y - box.top) / box.height) * photo.height_px];
  }

  /** Pixels of the photograph in one of the window. */
  private get px(): number {
    return studio.told!.photo!.width_px / this.stage.clientWidth;
  }

  private inside(at_px: Pair): Pair {
    const photo = studio.told!.photo!;
    const ground = groundOf(photo, studio.state);
    const [x, y] = ground ? ground.within(at_px) : at_px;
    const within = (value: number, most: number): number => Math.round(100 * Math.min(most - 1, Math.max(0, value))) / 100;
    return [within(x, photo.width_px), within(y, photo.height_px)];
  }

  /** The box of an object in the newest picture, if that shows all objects. */
  private boxOf(number: number): Box | null {
    const boxes = studio.shown?.boxes ?? [];
    return boxes.length === studio.objects.length ? boxes[number] ?? null : null;
  }

  /** Choose the object under a point of the window, the nearest if several are, unless the chosen one is there. Whether it did. */
  private chose(x: number, y: number): boolean {
    const [photo, state] = [studio.told?.photo, studio.state];
    if (!photo || !state) return false;
    const [x_px, y_px] = this.pixel(x, y);
    const [u, v] = [x_px / photo.width_px, y_px / photo.height_px];
    const under = studio.objects.flatMap((each, number) => {
      const box = this.boxOf(number);
      return box && u >= box[0] && u <= box[2] && v >= box[1] && v <= box[3] ? [{ number, foot: each.at_px[1] }] : [];
    });
    const nearest = under.sort((one, other) => other.foot - one.foot)[0];
    if (!nearest || under.some((each) => each.number === state.before.length)) return false;
    studio.change(studio.choosing(nearest.number));
    return true;
  }

  /** The button of the tool that waits for a hand on the picture. */
  private get tool(): string | null {
    return this.brush.on ? "brush" : this.lines.on ? "draw_lines" : this.shadow.on ? "sun_by" : this.stage.classList.contains("focusing") ? "focus_here" : null;
  }

  /** Whether a point of the window lies on the chosen object, or so near beside it. */
  private isBy(x: number, y: number, beside_px: number): boolean {
    const box = studio.isComplete ? this.boxOf(studio.state!.before.length) : null;
    const stage = this.stage.getBoundingClientRect();
    const [u, v, across, down] = [(x - stage.left) / stage.width, (y - stage.top) / stage.height, beside_px / stage.width, beside_px / stage.height];
    return box !== null && u >= box[0] - across && u <= box[2] + across && v >= box[1] - down && v <= box[3] + down;
  }

  private gestures(): void {
    this.stage.addEventListener("pointerdown", (event) => event.isPrimary && (this.shaping = null), true);
    listen(this.stage, {
      tap: (x, y) => this.tapped(x, y),
      twice: (x, y) => this.tapped(x, y),
      dragStart: (x, y) => {
        if (this.brush.on) return this.brush.start(this.pixel(x, y));
        if (this.lines.on) return this.lines.start(this.pixel(x, y), this.px);
        if (!this.loupe.on) this.chose(x, y);
        this.panning = this.view.isEnlarged && !this.loupe.on && (this.shadow.on || !this.isBy(x, y, BESIDE_PX));
        this.from = studio.state?.at_px ?? this.inside(this.pixel(x, y));
        this.moved = [0, 0];
        this.stage.classList.add("dragging");
      },
      drag: (x, y, dx, dy) => {
        if (this.brush.on) return this.brush.move(this.pixel(x, y));
        if (this.lines.on) return this.lines.move(this.pixel(x, y));
        if (this.panning) return this.view.by(1, x, y, dx, dy);
        // Under the loupe a finger looks, and moves nothing.
        if (!this.from || !studio.state?.object || this.loupe.on || this.shadow.on) return;
        this.moved = [this.moved[0] + dx * this.px, this.moved[1] + dy * this.px];
        studio.change({ at_px: this.inside([this.from[0] + this.moved[0], this.from[1] + this.moved[1]]) });
      },
      dragEnd: (pinched) => {
        if (this.brush.on) return pinched ? this.brush.drop() : void this.brush.end();
        if (this.lines.on) return this.lines.stop(this.px, pinched);
        this.from = null;
        this.panning = false;
        this.stage.classList.remove("dragging");
        void studio.commit();
      },
      // Two fingers on the object scale and turn it; elsewhere, while a tool waits, and in the enlarged picture they zoom that.
      pinch: (factor, x, y, dx, dy, turn_deg) => {
        this.shaping ??= this.tool === null && !this.view.isEnlarged && this.isBy(x, y, FINGERS_BESIDE_PX);
        return this.shaping ? this.shape(factor, turn_deg) : this.view.by(factor, x, y, dx, dy);
      },
      wheel: (factor, turn_deg) => (this.brush.on ? this.brush.scale(factor) : this.lines.on || this.shadow.on || this.shape(factor, turn_deg)),
      zoom: (factor, x, y, dx, dy) => this.view.by(factor, x, y, dx, dy),
    });
  }

  private tapped(x: number, y: number): void {
    this.stage.focus();
    if (!studio.told?.photo) return;
    if (this.brush.on) {
      this.brush.start(this.pixel(x, y));
      return void this.brush.end();
    }
    if (this.lines.on) return this.lines.tap(this.pixel(x, y), this.px);
    if (this.shadow.on) return void this.shadow.tap(this.pixel(x, y), this.px);
    if (this.stage.classList.contains("focusing")) return this.focusAt(x, y);
    if (this.chose(x, y)) return void studio.commit();
    if (!studio.state?.object) return studio.say("choose an object first: in the list at the right, or drop a GLB file");
    const ground = groundOf(studio.told.photo, studio.state);
    if (!ground || ground.isInSight) return void studio.commit({ at_px: this.inside(this.pixel(x, y)) });
    if (studio.told.clip) return studio.say("the first frame shows no ground of the track's world: begin the clip where it does");
    const at_px = this.pixel(x, y);
    void studio.commit({ at_px, camera: null, pitch_deg: ground.usualTilt_deg(at_px) });
    this.hint = "the camera looks up, so that no ground is in sight: another tilt is taken, see Camera and ground";
  }

  /** Scale and turn the object, and keep that once the hand rests. */
  private shape(factor: number, turn_deg: number): void {
    const state = studio.state;
    if (!state?.at_px) return;
    if (factor !== 1) studio.metresTyped = false;
    const turned = turn_deg ? { turn_deg: Number(within180(state.turn_deg + turn_deg).toFixed(2)) } : {};
    studio.change({ height: scaledHeight(state.height, factor), ...turned });
    this.commitLater();
  }

  private commitLater(): void {
    clearTimeout(this.later);
    this.later = setTimeout(() => void studio.commit(), NUDGES_REST_MS);
  }

  /** Focus where one clicked: on the object, on the ground there, or on what the depth shows. */
  private focusAt(x: number, y: number): void {
    const photo = studio.told!.photo!;
    const at_px = this.inside(this.pixel(x, y));
    byId<HTMLElement>("focus_here").click();
    if (photo.has_depth) return void studio.commit({ focus_at_px: at_px, focus_m: null });
    const ground = groundOf(photo, studio.state);
    if (!ground) return studio.say("the plain ground has no distance to focus on: turn Plain off, or type the metres");
    const box = this.boxOf(studio.state!.before.length);
    const [u, v] = [at_px[0] / photo.width_px, at_px[1] / photo.height_px];
    const onObject = box && u >= box[0] && u <= box[2] && v >= box[1] && v <= box[3];
    const metres = ground.distance_m(onObject && studio.state?.at_px ? studio.state.at_px : at_px);
    if (metres === null) return studio.say("the sky has no distance: click on the ground or the object");
    void studio.commit({ focus_m: Number(metres.toPrecision(4)), focus_at_px: null, camera_height_m: ground.high_m });
  }

  private keys(): void {
    this.stage.addEventListener("keydown", (event) => {
      const state = studio.state;
      if (event.ctrlKey || event.metaKey || event.altKey || !state?.at_px) return;
      const [x, y] = state.at_px;
      const step = event.shiftKey ? 10 : 1;
      const moves: Record<string, Pair> = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
      const shapes: Record<string, [number, number]> = { "+": [1.05, 0], "=": [1.05, 0], "-": [1 / 1.05, 0], "[": [1, -step], "]": [1, step], "{": [1, -10], "}": [1, 10] };
      const [move, shape] = [moves[event.key], shapes[event.key]];
      if (move) {
        const at_px = this.inside([x + step * move[0], y + step * move[1]]);
        studio.change({ at_px });
        this.view.reveal(at_px);
        this.commitLater();
      } else if (shape) this.shape(...shape);
      else if (event.key === "Delete" || event.key === "Backspace") studio.remove();
      else return;
      event.preventDefault();
    });
    document.addEventListener("keydown", (event) => {
      // What waits is left first, then the loupe, then the enlarged picture.
      const left = this.tool ?? (this.loupe.on ? "magnify" : this.view.isEnlarged ? "zoom" : null);
      if (event.key === "Escape" && left) byId<HTMLElement>(left).click();
      if (!(event.ctrlKey || event.metaKey) || (event.target as Element).matches?.("input[type=text], input[type=number]")) return;
      const key = event.key.toLowerCase();
      if (key !== "z" && key !== "y") return;
      event.preventDefault();
      void studio.step(key === "y" || event.shiftKey ? 1 : -1);
    });
  }

  private buttons(): void {
    const pressed = (id: string, told: (on: boolean) => void): void => {
      const button = byId<HTMLElement>(id);
      button.addEventListener("click", () => {
        const on = button.getAttribute("aria-pressed") !== "true";
        button.setAttribute("aria-pressed", String(on));
        told(on);
      });
    };
    pressed("grid", () => this.mark());
    const tools = ["focus_here", "brush", "draw_lines", "sun_by"];
    const isOn = (id: string): boolean => byId(id).getAttribute("aria-pressed") === "true";
    for (const id of tools) {
      // Before the tool itself is told: the others fall silent, then it speaks.
      byId(id).addEventListener("click", () => isOn(id) || tools.filter((each) => each !== id && isOn(each)).forEach((each) => byId<HTMLElement>(each).click()), true);
    }
    pressed("focus_here", (on) => {
      this.stage.classList.toggle("focusing", on);
      studio.say(on ? "click what is to be in focus: the object, or a place on the ground" : "", on);
    });
    this.stage.addEventListener("pointermove", (event) => {
      if (this.brush.on && studio.told?.photo) this.brush.hover(this.pixel(event.clientX, event.clientY));
    });
    const hold = byId<HTMLElement>("hold_before");
    const show = (on: boolean): void => {
      this.before.hidden = !on && byId("brush_hide").getAttribute("aria-pressed") !== "true";
      studio.dispatchEvent(new Event("before"));
    };
    hold.addEventListener("pointerdown", () => show(true));
    for (const end of ["pointerup", "pointercancel", "pointerleave", "blur"]) hold.addEventListener(end, () => show(false));
    hold.addEventListener("keydown", (event) => (event.key === " " || event.key === "Enter") && show(true));
    hold.addEventListener("keyup", () => show(false));
  }
}
