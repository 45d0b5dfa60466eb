// What of the picture is in sight: fitted to the window or enlarged, there with the finished picture's own pixels, and the loupe.
import { byId, type Pair, studio } from "./studio_model";

const MOST = 4;
const LOOKS_MS = 150;
const LOUPE_PX = 240;
/** The largest square that the server makes of the finished picture, in pixels of the photograph. */
const LARGEST_PX = 1600;
/** From so many pixels of the screen to one of the preview on, the finished picture's own pixels are asked for. */
const COARSE = 1.15;

export class View {
  private readonly stage = byId<HTMLElement>("stage");
  private readonly picture = byId<HTMLCanvasElement>("picture");
  private readonly sharp = byId<HTMLCanvasElement>("sharp");
  private readonly sharpBefore = byId<HTMLCanvasElement>("sharp_before");
  private readonly before = byId<HTMLImageElement>("before");
  private readonly button = byId<HTMLElement>("zoom");
  /** Times the fitted size, and what of the photograph lies in the middle of the window, in shares of it. */
  private times = 1;
  private middle: Pair = [0.5, 0.5];
  private laid = "";
  private looking: ReturnType<typeof setTimeout> | undefined;

  constructor() {
    this.button.addEventListener("click", () => (this.isEnlarged ? this.reset() : this.enlarge()));
    studio.addEventListener("state", () => studio.isComplete && (this.sharp.hidden = true));
    studio.addEventListener("picture", () => studio.shown?.draft || this.lookLater());
    studio.addEventListener("before", () => this.before.hidden ? (this.sharpBefore.hidden = true) : void this.look(this.sharpBefore));
  }

  get isEnlarged(): boolean {
    return this.times > 1;
  }

  private get room(): DOMRect {
    return byId("room").getBoundingClientRect();
  }

  /** Pixels of the window to one of the photograph where all of it is in sight. */
  private get fitted(): number {
    const photo = studio.told!.photo!;
    return Math.min(this.room.width / photo.width_px, this.room.height / photo.height_px);
  }

  /** How large pixels of the photograph are on the screen: 1 shows one by one. */
  private get scale(): number {
    return this.fitted * this.times * devicePixelRatio;
  }

  /** Lay the picture out; nothing else does. */
  fit(): void {
    const photo = studio.told!.photo!;
    const [room, size] = [this.room, this.fitted * this.times];
    const [width, height] = [photo.width_px * size, photo.height_px * size];
    const place = (share: number, most: number, length: number): number => (length <= most ? (most - length) / 2 : Math.min(0, Math.max(most - length, most / 2 - share * length)));
    const [left, top] = [place(this.middle[0], room.width, width), place(this.middle[1], room.height, height)];
    this.middle = [(room.width / 2 - left) / width, (room.height / 2 - top) / height];
    Object.assign(this.stage.style, { width: `${width}px`, height: `${height}px`, left: `${left}px`, top: `${top}px` });
    studio.pixels = Math.max(4e4, photo.width_px * photo.height_px * (this.fitted * devicePixelRatio) ** 2);
    this.button.setAttribute("aria-pressed", String(this.isEnlarged));
    const told = byId<HTMLElement>("scale");
    told.hidden = !this.isEnlarged;
    told.textContent = `${Math.round(100 * this.scale)} %`;
    studio.dispatchEvent(new Event("view"));
    // News of the server leave the picture where it is.
    const laid = `${width} ${left} ${top}`;
    if (laid !== this.laid) this.lookLater();
    this.laid = laid;
  }

  /** Enlarge about a point of the window, which moved by (dx, dy): what lies under it stays there. */
  by(factor: number, x: number, y: number, dx = 0, dy = 0): void {
    if (!studio.told?.photo) return;
    const [room, box] = [this.room, this.stage.getBoundingClientRect()];
    const share: Pair = [(x - dx - box.left) / box.width, (y - dy - box.top) / box.height];
    const most = Math.max(MOST, MOST / (this.fitted * devicePixelRatio));
    const times = Math.min(most, Math.max(1, this.times * factor));
    const grown = times / this.times;
    this.times = times;
    this.middle = [share[0] + (room.left + room.width / 2 - x) / (box.width * grown), share[1] + (room.top + room.height / 2 - y) / (box.height * grown)];
    this.fit();
  }

  reset(): void {
    [this.times, this.middle] = [1, [0.5, 0.5]];
    this.sharp.hidden = this.sharpBefore.hidden = true;
    if (studio.told?.photo) this.fit();
  }

  /** One pixel of the photograph to one of the screen, about the object; twice the size where that is less. */
  private enlarge(): void {
    const [photo, state] = [studio.told?.photo, studio.state];
    if (!photo || !state) return;
    this.times = Math.max(2, 1 / (this.fitted * devicePixelRatio));
    const box = studio.isComplete ? studio.shown?.boxes[state.before.length] : null;
    // The foot, where the whole object is too high.
    const high = this.room.height / (photo.height_px * this.fitted * this.times);
    if (box) this.middle = [(box[0] + box[2]) / 2, box[3] - box[1] < high ? (box[1] + box[3]) / 2 : box[3] - 0.3 * high];
    this.fit();
    const hand = matchMedia("(pointer: coarse)").matches ? "two fingers zoom and move the picture" : "Ctrl and the wheel zoom, dragging beside the object moves the picture";
    studio.say(`${hand}; Zoom again shows all of it`);
  }

  /** Left, top, right and bottom of what is in sight, in pixels of the photograph. */
  get inSight(): [number, number, number, number] {
    const photo = studio.told!.photo!;
    const [room, box] = [this.room, this.stage.getBoundingClientRect()];
    const share = (at: number, from: number, length: number): number => Math.min(1, Math.max(0, (at - from) / length));
    const [left, right] = [share(room.left, box.left, box.width), share(room.right, box.left, box.width)];
    const [top, bottom] = [share(room.top, box.top, box.height), share(room.bottom, box.top, box.height)];
    return [left * photo.width_px, top * photo.height_px, right * photo.width_px, bottom * photo.height_px];
  }

  /** Bring a pixel of the photograph into sight. */
  reveal([x_px, y_px]: Pair): void {
    const photo = studio.told!.photo!;
    const [left, top, right, bottom] = this.inSight;
    if (x_px > left && x_px < right && y_px > top && y_px < bottom) return;
    this.middle = [x_px / photo.width_px, y_px / photo.height_px];
    this.fit();
  }

  /** What is shown is of another picture than before. */
  lookAnew(): void {
    this.sharp.hidden = this.sharpBefore.hidden = true;
    this.lookLater();
  }

  private lookLater(): void {
    clearTimeout(this.looking);
    if (this.isEnlarged) this.looking = setTimeout(() => void this.lookAgain(), LOOKS_MS);
  }

  private async lookAgain(): Promise<void> {
    if (!this.before.hidden) await this.look(this.sharpBefore);
    await this.look(this.sharp);
  }

  /** Lay the own pixels of the finished picture, or of the photograph, over the preview, where that is too coarse. */
  private async look(sharp: HTMLCanvasElement): Promise<void> {
    const [timer, photo] = [this.looking, studio.told!.photo!];
    const coarse = this.stage.clientWidth * devicePixelRatio > COARSE * this.picture.width && this.picture.width < photo.width_px;
    if (!coarse || !this.isEnlarged) return;
    const [left, top, right, bottom] = this.inSight;
    const side = Math.min(LARGEST_PX, Math.ceil(Math.max(right - left, bottom - top)) + 2);
    const [x, y] = [Math.round((left + right) / 2), Math.round((top + bottom) / 2)];
    const isBefore = sharp === this.sharpBefore;
    const bitmap = await studio.region(x, y, side, isBefore).catch(() => null);
    if (!bitmap || timer !== this.looking || (isBefore && this.before.hidden)) return;
    [sharp.width, sharp.height] = [side, side];
    sharp.getContext("2d")!.drawImage(bitmap, 0, 0);
    const percent = (value: number, most: number): string => `${(100 * value) / most}%`;
    const [across, down] = [x - Math.floor(side / 2), y - Math.floor(side / 2)];
    Object.assign(sharp.style, { left: percent(across, photo.width_px), top: percent(down, photo.height_px), width: percent(side, photo.width_px), height: percent(side, photo.height_px) });
    sharp.hidden = false;
  }
}

/** Shows what lies under the pointer with one pixel of the photograph to one of the screen: the preview, then the finished picture. */
export class Loupe {
  private readonly stage = byId<HTMLElement>("stage");
  private readonly picture = byId<HTMLCanvasElement>("picture");
  private readonly glass = byId<HTMLCanvasElement>("loupe");
  private looking: ReturnType<typeof setTimeout> | undefined;

  constructor() {
    const button = byId<HTMLElement>("magnify");
    button.addEventListener("click", () => {
      button.setAttribute("aria-pressed", String(!this.on));
      this.glass.hidden = !this.on;
      this.glass.style.left = "-9999px";  // until a pointer shows where
    });
    this.stage.addEventListener("pointermove", (event) => this.on && studio.told?.photo && this.magnify(event));
  }

  get on(): boolean {
    return byId("magnify").getAttribute("aria-pressed") === "true";
  }

  private magnify(event: PointerEvent): void {
    const [box, room] = [this.stage.getBoundingClientRect(), byId("room").getBoundingClientRect()];
    const [x, y] = [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
    const photo = studio.told!.photo!;
    const side = LOUPE_PX * devicePixelRatio;
    this.glass.width = this.glass.height = side;
    const cut = (side * this.picture.width) / photo.width_px;
    this.glass.getContext("2d")!.drawImage(this.picture, x * this.picture.width - cut / 2, y * this.picture.height - cut / 2, cut, cut, 0, 0, side, side);
    const within = (value: number, most: number): number => Math.min(Math.max(0, most - LOUPE_PX), Math.max(0, value));
    Object.assign(this.glass.style, { left: `${within(event.clientX - room.left + 20, room.width)}px`, top: `${within(event.clientY - room.top - LOUPE_PX - 20, room.height)}px` });
    clearTimeout(this.looking);
    this.looking = setTimeout(() => void this.look([x * photo.width_px, y * photo.height_px], side), LOOKS_MS);
  }

  private async look([x_px, y_px]: Pair, side: number): Promise<void> {
    const timer = this.looking;
    const bitmap = await studio.region(x_px, y_px, side).catch(() => null);
    if (bitmap && timer === this.looking && this.on) this.glass.getContext("2d")!.drawImage(bitmap, 0, 0, side, side);
    if (bitmap) this.glass.dataset.looked = String(Number(this.glass.dataset.looked ?? 0) + 1);
  }
}
