// What the studio knows: the server's state, what this page changes, and the newest picture of it.
import type { Matrix3 } from "./model";
import { sentenceOf } from "./server";

export const byId = <T extends Element>(id: string): T => document.getElementById(id) as unknown as T;

export type Pair = [number, number];

/** Both ends of an edge in pixels, and its direction in the world: y upright, x and z the two level ones; h is the horizon. */
export type DrawnLine = [number, number, number, number, "x" | "y" | "z" | "h"];

/** Both ends of something upright on the ground, and how many metres high it is. */
export type Measured = [number, number, number, number, number];

/** An object that stands in the photograph. */
export interface Placed {
  object: string;
  at_px: Pair;
  height: string | null;
  turn_deg: number;
}

/** The state as the server keeps it; null leaves a thing to the command's own default. Object, place, height and turn are the chosen one's. */
export interface State {
  photo: string | null;
  clip: string | null;
  track: string | null;
  slice: number | null;
  matte: string | null;
  object: string | null;
  lens: string | null;
  camera: string | null;
  lines: DrawnLine[];
  at_px: Pair | null;
  height: string | null;
  turn_deg: number;
  before: Placed[];
  after: Placed[];
  pitch_deg: number | null;
  roll_deg: number | null;
  camera_height_m: number | null;
  measured: Measured | null;
  focal_length_mm: number | null;
  sensor_width_mm: number | null;
  f_number: number | null;
  focus_m: number | null;
  focus_at_px: Pair | null;
  sun_deg: Pair | null;
  shadow: number | null;
  exposure: number;
  warmth_k: number | null;
  matched: boolean;
  plain: boolean;
}

export interface Photo {
  name: string;
  width_px: number;
  height_px: number;
  has_depth: boolean;
  f_number: number | null;
  focus_m: number | null;
  focal_length_mm: number | null;
  focal_px: number | null;
  camera_height_m: number | null;
  world_from_camera: Matrix3 | null;
  pitch_deg: number | null;
  roll_deg: number | null;
  lens_f_number: number | null;
  /** How far the lens opens; null: as far as one likes. */
  widest_f_number?: number | null;
  /** Where the sun stood by the file: degrees to the right of the view, and above the horizon. */
  sun_deg: Pair | null;
  /** Of a focal stack: which picture this is, how many there are, and where each is focused. */
  slice?: number;
  slices?: number;
  focus_distances_m?: (number | null)[];
  problem?: string;
}

export interface Save {
  number: number;
  name: string;
  path: string;
  state: "running" | "done" | "failed" | "cancelled";
  sentence: string;
  seconds: number;
}

export interface Told {
  number: number;
  state: State;
  busy: string;
  problem: string;
  can_undo: boolean;
  can_redo: boolean;
  objects: { path: string; name: string }[];
  lenses: { path: string; name: string }[];
  saves: Save[];
  formats: string[];
  /** The one that was saved last. */
  format: string;
  project: string;
  largest: { photo: number; object: number };
  camera: { told: string; file?: string } | null;
  command: string | null;
  photo: Photo | null;
  /** Of a clip: the command that films it, and where the chosen object's foot is seen in its frames. */
  clip: { name: string; command: string | null; path_px: Pair[] } | null;
}

export type Box = [number, number, number, number];

/** What comes with a picture. boxes: left, top, right, bottom of each object in shares of the picture. */
export interface Shown {
  boxes: (Box | null)[];
  blur: string;
  focus_m: number | null;
  f_number: number;
  coc_px: number[];
  guessed: string[];
  warnings: string[];
  command: string | null;
  ms: number;
  draft: boolean;
}

const RESTS_MS = 250;
const SENTENCE_MS = 8000;

const pageName = `p${Math.random().toString(36).slice(2)}`;

export class Studio extends EventTarget {
  told: Told | null = null;
  shown: Shown | null = null;
  sentence = "";
  /** Pictures that reached the screen, and how long the last draft took from the change to the screen. */
  counts = { drafts: 0, whole: 0, draft_ms: 0, whole_ms: 0 };
  pixels = 1e6;
  /** Whether the height of the object was typed in metres, which then stay. */
  metresTyped = false;
  private local: Partial<State> = {};
  private sending: Partial<State> = {};
  private sends: Promise<void> = Promise.resolve();
  private changes = 0;
  private finished = -1;
  private drafting = false;
  private warned = false;
  private resting: ReturnType<typeof setTimeout> | undefined;
  private quiet: ReturnType<typeof setTimeout> | undefined;

  /** The state as this page sees it now. */
  get state(): State | null {
    return this.told && { ...this.told.state, ...this.sending, ...this.local };
  }

  /** All objects that have a place, in their order. */
  get objects(): Placed[] {
    const state = this.state;
    if (!state) return [];
    const { object, at_px, height, turn_deg } = state;
    return [...state.before, ...(object && at_px ? [{ object, at_px, height, turn_deg }] : []), ...state.after];
  }

  get isComplete(): boolean {
    const state = this.state;
    return Boolean(this.told?.photo && state?.photo && state.object && state.at_px);
  }

  /** Whether something of this page is not in the server's state yet. */
  get isChanging(): boolean {
    return Object.keys(this.local).length + Object.keys(this.sending).length > 0;
  }

  say(sentence: string, stays = false): void {
    this.sentence = sentence;
    clearTimeout(this.quiet);
    if (sentence && !stays) this.quiet = setTimeout(() => this.say(""), SENTENCE_MS);
    this.dispatchEvent(new Event("sentence"));
  }

  /** Change the state on this page; it is drawn at once, and kept by `commit`. */
  change(changes: Partial<State>): void {
    Object.assign(this.local, changes);
    this.dispatchEvent(new Event("state"));
    this.draw();
  }

  /** The changes by which one of all objects is chosen. */
  choosing(number: number, objects: Placed[] = this.objects): Partial<State> {
    const chosen = objects[number];
    if (!chosen) return { object: null, at_px: null, height: null, turn_deg: 0, before: [], after: [] };
    return { ...chosen, before: objects.slice(0, number), after: objects.slice(number + 1) };
  }

  /** Take the chosen object away; the one before it is chosen. */
  remove(): void {
    const number = this.state?.before.length ?? 0;
    const rest = this.objects.filter((_, each) => each !== number);
    if (this.state?.object) void this.commit(this.choosing(Math.max(0, number - 1), rest));
  }

  /** Add an object beside the chosen one. */
  async add(object: string): Promise<void> {
    await this.commit();
    const told = await this.post("/add", { object });
    if (told) this.take(told);
  }

  /** Keep what was changed: one step of the history. */
  commit(changes: Partial<State> = {}): Promise<void> {
    if (Object.keys(changes).length) this.change(changes);
    this.sends = this.sends.then(async () => {
      if (!Object.keys(this.local).length) return;
      this.sending = this.local;
      this.local = {};
      const told = await this.post("/state", { changes: this.sending, metres_typed: this.metresTyped });
      this.sending = {};
      if (told) this.take(told);
      else this.dispatchEvent(new Event("state"));
    });
    return this.sends;
  }

  async step(by: 1 | -1): Promise<void> {
    await this.commit();
    const told = await this.post("/history", { step: by });
    if (told) this.take(told);
  }

  /** Take over what the server tells; a state that others changed is drawn. */
  take(told: Told): void {
    if (this.told && told.number < this.told.number) return;
    const before = JSON.stringify([this.told?.state, this.told?.photo]);
    this.told = told;
    if (told.problem) this.say(told.problem, true);
    this.dispatchEvent(new Event("told"));
    if (JSON.stringify([told.state, told.photo]) !== before) {
      this.dispatchEvent(new Event("state"));
      this.draw();
    }
  }

  /** Keep asking for news. */
  async follow(): Promise<void> {
    for (;;) {
      try {
        const answer = await fetch(`/state${this.told ? `?after=${this.told.number}` : ""}`);
        if (!answer.ok) throw new Error(await sentenceOf(answer));
        const told = (await answer.json()) as Told;
        if (this.sentence.startsWith("the studio does not answer")) this.say("");
        // A studio that was started anew counts from the beginning.
        if (this.told && told.number < this.told.number) this.told = null;
        this.take(told);
      } catch (problem) {
        const why = problem instanceof TypeError ? "" : ` (${(problem as Error).message})`;
        this.say(`the studio does not answer${why}: nothing is lost, this page tries again`, true);
        await new Promise((done) => setTimeout(done, 1000));
        if (this.told) this.told.number = -1;
      }
    }
  }

  async post(path: string, message: unknown): Promise<Told | null> {
    try {
      const answer = await fetch(path, { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(message) });
      if (answer.ok) return (await answer.json()) as Told;
      this.say(await sentenceOf(answer));
    } catch {
      this.say("the studio does not answer: nothing is lost, try again");
    }
    return null;
  }

  async upload(file: File): Promise<void> {
    const kind = /\.(glb|gltf)$/i.test(file.name) ? "object" : "photo";
    const most = this.told?.largest[kind] ?? Infinity;
    if (file.size > most) return this.say(`${file.name} is larger than the ${most >> 20} MB that the studio takes: give it on the command line`);
    this.say(`sending ${file.name} ...`, true);
    try {
      const answer = await fetch(`/upload?kind=${kind}&name=${encodeURIComponent(file.name)}`, { method: "POST", body: file });
      if (!answer.ok) return this.say(await sentenceOf(answer));
      const said = this.isComplete ? "the object is added beside the chosen one: drag it to its place" : "click into the photograph where the object is to stand";
      this.say(kind === "object" ? said : "");
      this.take((await answer.json()) as Told);
    } catch {
      this.say(`${file.name} did not arrive: the studio does not answer`);
    }
  }

  /** Ask for a picture: a draft as soon as the last one is there, the whole one when the hand rests. */
  draw(): void {
    this.changes++;
    clearTimeout(this.resting);
    if (!this.isComplete) return;
    void this.draft();
    this.resting = setTimeout(() => void this.whole(this.changes), RESTS_MS);
  }

  private async draft(): Promise<void> {
    if (this.drafting) return;
    this.drafting = true;
    for (let drawn = -1; drawn !== this.changes && this.isComplete;) {
      drawn = this.changes;
      await this.ask(true, drawn);
    }
    this.drafting = false;
  }

  private async whole(change: number): Promise<void> {
    if (change === this.changes) await this.ask(false, change);
  }

  /** The part of the finished picture, or of the photograph as it is, around a pixel; null where another one was asked for since. */
  async region(x_px: number, y_px: number, side_px: number, before = false): Promise<ImageBitmap | null> {
    const region = [x_px, y_px, side_px, this.shown?.coc_px[1] ?? 0];
    const message = { changes: { ...this.sending, ...this.local }, pixels: this.pixels, page: before ? `${pageName}b` : pageName, region, before };
    const answer = await fetch("/preview", { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(message) });
    if (answer.status !== 200) return null;
    const body = await answer.arrayBuffer();
    const length = new DataView(body).getUint32(0);
    return createImageBitmap(new Blob([new Uint8Array(body, 4 + length)], { type: "image/jpeg" }));
  }

  private async ask(draft: boolean, change: number): Promise<void> {
    const began = performance.now();
    const message = { changes: { ...this.sending, ...this.local }, draft, pixels: this.pixels, page: pageName };
    try {
      const answer = await fetch("/preview", { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(message) });
      if (answer.status === 204) return;
      if (!answer.ok) {
        this.warned = true;
        return this.say(await sentenceOf(answer), true);
      }
      const body = await answer.arrayBuffer();
      const length = new DataView(body).getUint32(0);
      const shown = JSON.parse(new TextDecoder().decode(new Uint8Array(body, 4, length))) as Shown;
      const bitmap = await createImageBitmap(new Blob([new Uint8Array(body, 4 + length)], { type: "image/jpeg" }));
      // A finished picture of what has changed since is older than the draft on the screen.
      if (!draft && change !== this.changes) return;
      // So is a draft that comes after the finished picture of its change.
      if (draft && change <= this.finished) return;
      if (!draft) this.finished = change;
      this.shown = shown;
      if (shown.warnings[0] || this.warned) this.say(shown.warnings[0] ?? "", true);
      this.warned = Boolean(shown.warnings[0]);
      this.counts[draft ? "drafts" : "whole"]++;
      this.counts[draft ? "draft_ms" : "whole_ms"] = Math.round(performance.now() - began);
      this.dispatchEvent(new CustomEvent("picture", { detail: bitmap }));
    } catch {
      this.say("the studio does not answer: nothing is lost, this page tries again", true);
      this.warned = true;
    }
  }
}

export const studio = new Studio();

/** A place within the photograph, in tenths of its pixels. */
export function inPhoto([x, y]: Pair): Pair {
  const within = (value: number, most: number): number => Number(Math.min(most, Math.max(0, value)).toFixed(1));
  return [within(x, studio.told?.photo?.width_px ?? 0), within(y, studio.told?.photo?.height_px ?? 0)];
}

/** The height, scaled, with so many digits; its unit stays. */
export function scaledHeight(height: string | null, factor: number, digits = 6): string | null {
  if (height === null) return null;
  const unit = height.endsWith("px") ? "px" : "";
  return `${Number((parseFloat(height) * factor).toPrecision(digits))}${unit}`;
}
