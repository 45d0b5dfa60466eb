// What the page knows: the state of the viewfinder, the picture that is shown, and a sentence for the user.

export type Matrix3 = [[number, number, number], [number, number, number], [number, number, number]];

/** GET /state; what is missing is not offered. Distances in metres, null is infinity. */
export interface State {
  role: "view" | "control";
  transports: string[];
  matte: boolean;
  can_send: boolean;
  gallery?: boolean;
  source?: string;
  width_px?: number;
  height_px?: number;
  dioptre_range?: [number, number];
  focus_distance_m?: number | null;
  /** Who told it; null is the file of the lens. */
  focus_from?: string | null;
  f_number?: number;
  f_numbers?: number[];
  lens?: string;
  lenses?: string[];
  renderer?: string;
  renderers?: string[];
  view?: string;
  views?: string[];
  objects?: { name: string; visible: boolean }[];
  ground_from_picture?: Matrix3 | null;
  can_capture?: boolean;
  can_record?: boolean;
  recording?: boolean;
  /** Of the take under way; how much longer the disk will do. */
  recorded_s?: number | null;
  room_s?: number | null;
  /** What happened by itself, such as a full disk; numbers grow. */
  notices?: { number: number; sentence: string }[];
  smoothing?: boolean | null;
  failure?: string | null;
  remark?: Remark | null;
}

/** Why nothing virtual is seen, or that the picture is old; arrow: right and down, to where the object is. */
export interface Remark {
  sentence: string;
  arrow: [number, number] | null;
}

/** What comes with each picture. captured_ms: in the server's time. */
export interface FrameHeader {
  sequence: number;
  captured_ms: number;
  focus_distance_m?: number | null;
  f_number?: number;
  focus_pending?: boolean;
  tracking?: number | null;
  tracking_unsure?: boolean;
  layer_age_ms?: number;
  stages_ms?: Record<string, number>;
  dropped?: number;
  remark?: Remark | null;
}

/** A picture on the page: where its pixels are, and what is known of it. */
export interface ShownFrame {
  pixels: HTMLCanvasElement | HTMLVideoElement;
  header: FrameHeader | null;
}

const NOTICE_S = 10;

class Model extends EventTarget {
  state: State | null = null;
  shown: ShownFrame | null = null;
  way = "";
  sentence = "";
  private silence = 0;
  private failing = false;
  private noticed = 0;

  setState(state: State): void {
    this.state = state;
    this.dispatchEvent(new Event("state"));
    const unseen = (state.notices ?? []).filter((each) => each.number > this.noticed);
    if (unseen.length === 0) return;
    this.noticed = Math.max(...unseen.map((each) => each.number));
    this.say(unseen.map((each) => each.sentence).join(" · "), NOTICE_S);
  }

  show(frame: ShownFrame): void {
    this.shown = frame;
    if (this.failing) this.say("");
    this.dispatchEvent(new Event("frame"));
  }

  setWay(way: string): void {
    this.way = way;
    this.dispatchEvent(new Event("way"));
  }

  /** Show a sentence; forSeconds null keeps it until another one comes. */
  say(sentence: string, forSeconds: number | null = null): void {
    clearTimeout(this.silence);
    this.failing = false;
    this.sentence = sentence;
    this.dispatchEvent(new Event("sentence"));
    if (forSeconds !== null) this.silence = window.setTimeout(() => this.say(""), 1000 * forSeconds);
  }

  /** The stream stands still for a reason, until the next picture. */
  fail(sentence: string): void {
    this.say(sentence);
    this.failing = true;
  }

  get mayControl(): boolean {
    return this.state?.role === "control";
  }
}

export const model = new Model();

export function distanceText(metres: number | null): string {
  if (metres === null || metres > 100) return "∞";
  return metres < 1 ? `${(100 * metres).toFixed(0)} cm` : `${metres.toFixed(2)} m`;
}
