// The panel: fields for everything of the state, the light's dome, the command line and the saves.
import { groundOf } from "./studio_ground";
import { byId, type Pair, type Placed, type Save, scaledHeight, type State, studio } from "./studio_model";

const F_NUMBERS = [1, 1.2, 1.4, 1.8, 2, 2.2, 2.4, 2.8, 3.2, 3.5, 4, 4.5, 5, 5.6, 6.3, 7.1, 8, 9, 10, 11, 13, 14, 16, 18, 20, 22, 25, 29, 32];
const LONG_FORMATS: Record<string, string> = { png: "PNG, 16 bit", jpeg: "JPEG", tiff: "TIFF, 16 bit", exr: "EXR, layers", clip: "Clip, MP4" };
/** As the server guesses where only the exposure tells of the sun. */
const DEFAULT_SUN: Pair = [-125, 50];

/** Daylight of 6504 K in millionths of 1 / K, by which equal steps look alike. */
const DAYLIGHT_MIRED = 1e6 / 6504;

interface Slider {
  id: string;
  read: (state: State) => number;
  write: (value: number) => Partial<State>;
  shown: (value: number, state: State) => string;
}

const nearestF = (f_number: number): number => {
  const apart = F_NUMBERS.map((each) => Math.abs(Math.log(each / f_number)));
  return apart.indexOf(Math.min(...apart));
};
const degrees = (value: number): string => `${value}°`;

const SLIDERS: Slider[] = [
  { id: "turn", read: (s) => s.turn_deg, write: (turn_deg) => ({ turn_deg }), shown: (v) => degrees(Math.round(v)) },
  {
    id: "f_number",
    read: (s) => nearestF(s.f_number ?? studio.told?.photo?.lens_f_number ?? 8),
    write: (value) => ({ f_number: Math.max(F_NUMBERS[Math.min(value, F_NUMBERS.length - 1)]!, studio.told?.photo?.widest_f_number ?? 0) }),
    shown: (_v, s) => `f/${Number((s.f_number ?? studio.told?.photo?.lens_f_number ?? 8).toPrecision(3))}`,
  },
  { id: "sun_right", read: (s) => sunOf(s)[0], write: (v) => sun([v, above()]), shown: (v, s) => (s.sun_deg ? `${Math.abs(Math.round(v))}° ${v < 0 ? "left" : "right"}` : "") },
  { id: "sun_above", read: (s) => sunOf(s)[1], write: (v) => sun([right(), v]), shown: (v, s) => (s.sun_deg ? degrees(Math.round(v)) : "") },
  {
    id: "exposure",
    read: (s) => Math.log2(Math.max(s.exposure, 1e-3)),
    write: (v) => ({ exposure: Number((2 ** v).toPrecision(4)) }),
    shown: (v) => `${v > 0 ? "+" : ""}${v.toFixed(1)} stops`,
  },
  {
    id: "warmth",
    read: (s) => (s.warmth_k ? Math.round(DAYLIGHT_MIRED - 1e6 / s.warmth_k) : 0),
    write: (v) => ({ warmth_k: v === 0 ? null : Math.round(1e6 / (DAYLIGHT_MIRED - v)) }),
    shown: (v) => (v === 0 ? "as guessed" : `${v > 0 ? "warmer" : "cooler"} by ${Math.abs(v)}`),
  },
  { id: "shadow", read: (s) => s.shadow ?? 1, write: (v) => ({ shadow: v === 1 ? null : v }), shown: (v) => `${Math.round(100 * v)} %` },
  { id: "pitch", read: (s) => s.pitch_deg ?? studio.told?.photo?.pitch_deg ?? 0, write: (pitch_deg) => keepingSizes({ pitch_deg }), shown: (v) => degrees(v) },
  { id: "roll", read: (s) => s.roll_deg ?? studio.told?.photo?.roll_deg ?? 0, write: (roll_deg) => keepingSizes({ roll_deg }), shown: (v) => degrees(v) },
];

/** Where the sun is, or would be: as told, as the file tells, or somewhere. */
const sunOf = (state: State | null): Pair => state?.sun_deg ?? studio.told?.photo?.sun_deg ?? DEFAULT_SUN;
const right = (): number => sunOf(studio.state)[0];
const above = (): number => sunOf(studio.state)[1];
/** A told light takes the plain, even one away. */
const sun = (sun_deg: Pair): Partial<State> => ({ sun_deg, plain: false });

const NUMBERS: { id: string; name: keyof State; also?: Partial<State> }[] = [
  { id: "focus", name: "focus_m", also: { focus_at_px: null } },
  { id: "camera_height", name: "camera_height_m", also: { measured: null } },
  { id: "focal_length", name: "focal_length_mm" },
  { id: "sensor_width", name: "sensor_width_mm" },
];

export class Panel {
  constructor() {
    for (const each of SLIDERS) this.slider(each);
    for (const each of NUMBERS) this.number(each.id, each.name, each.also ?? {});
    this.height();
    this.slices();
    this.switches();
    this.dome();
    this.result();
    this.files();
    this.saveAtOnce();
    const react = (id: string, changes: () => Partial<State>): void => byId(id).addEventListener("click", () => void studio.commit(changes()));
    react("focus_auto", () => ({ focus_m: null, focus_at_px: null }));
    react("f_number_auto", () => ({ f_number: null }));
    react("camera_found", () => ({ camera: studio.told?.camera?.file ?? null, pitch_deg: null, roll_deg: null }));
    byId("object").addEventListener("change", (event) => {
      const object = (event.target as HTMLSelectElement).value;
      if (object) void studio.commit({ object, height: null });
      else studio.remove();
    });
    byId("chosen").addEventListener("change", (event) => void studio.commit(studio.choosing(Number((event.target as HTMLSelectElement).value))));
    byId("add").addEventListener("change", (event) => {
      const select = event.target as HTMLSelectElement;
      if (select.value) void studio.add(select.value);
      select.value = "";
    });
    byId("remove").addEventListener("click", () => studio.remove());
    for (const [id, by] of [["undo", -1], ["redo", 1]] as const) byId(id).addEventListener("click", () => void studio.step(by));
    studio.addEventListener("told", () => this.told());
    studio.addEventListener("state", () => this.state());
    studio.addEventListener("picture", () => this.shown());
    studio.addEventListener("sentence", () => (byId("message").textContent = studio.sentence));
  }

  private slider(each: Slider): void {
    const input = byId<HTMLInputElement>(each.id);
    // A finger that only scrolls the panel over it leaves it as it was.
    let before: number | null = null;
    input.addEventListener("pointerdown", () => (before = studio.state ? each.read(studio.state) : null));
    input.addEventListener("pointercancel", () => before !== null && void studio.commit(each.write(before)));
    if (each.id === "f_number") input.max = String(F_NUMBERS.length - 1);
    input.addEventListener("input", () => studio.change(each.write(input.valueAsNumber)));
    input.addEventListener("change", () => void studio.commit(each.write(input.valueAsNumber)));
  }

  private number(id: string, name: keyof State, also: Partial<State>): void {
    const input = byId<HTMLInputElement>(id);
    input.addEventListener("change", () => {
      const value = input.value === "" ? null : input.valueAsNumber;
      if (value !== null && !(value > 0)) return studio.say("give a number above 0, or nothing for automatic");
      const changes = { [name]: value, ...also };
      void studio.commit(id === "camera_height" ? keepingSizes(changes) : changes);
    });
  }

  private height(): void {
    const input = byId<HTMLInputElement>("height");
    input.addEventListener("change", () => {
      studio.metresTyped = !input.value.trim().endsWith("px");
      void studio.commit({ height: input.value.trim().replace(",", ".") || null });
    });
  }

  /** Another picture of the stack is opened once the hand lets the handle go. */
  private slices(): void {
    const input = byId<HTMLInputElement>("slice");
    input.addEventListener("input", () => this.sliceTold(input.valueAsNumber));
    input.addEventListener("change", () => void studio.commit({ slice: input.valueAsNumber }));
  }

  private sliceTold(slice: number): void {
    const photo = studio.told?.photo;
    const metres = photo?.focus_distances_m?.[slice];
    const told = `slice ${slice} of 0 to ${(photo?.slices ?? 1) - 1}${metres ? `, focused at ${Number(metres.toPrecision(3))} m` : ""}`;
    byId("slice_row").querySelector("output")!.textContent = told;
    byId("slice").setAttribute("aria-valuetext", told);
  }

  private switches(): void {
    const auto = byId<HTMLInputElement>("sun_auto");
    auto.addEventListener("change", () => void studio.commit(auto.checked ? { sun_deg: null } : sun([right(), above()])));
    const matched = byId<HTMLInputElement>("matched");
    matched.addEventListener("change", () => void studio.commit({ matched: matched.checked }));
    const plain = byId<HTMLInputElement>("plain");
    plain.addEventListener("change", () => void studio.commit(plain.checked ? { plain: true, sun_deg: null } : { plain: false }));
  }

  /** The handle on the dome: the middle is overhead, the rim the horizon, up is ahead. */
  private dome(): void {
    const dome = byId<SVGSVGElement>("dome");
    const moved = (event: PointerEvent): void => {
      const box = dome.getBoundingClientRect();
      const [x, y] = [((event.clientX - box.left) / box.width) * 220 - 110, ((event.clientY - box.top) / box.height) * 220 - 110];
      const high = Math.max(2, Math.round(90 - 0.9 * Math.min(100, Math.hypot(x, y))));
      studio.change(sun([Math.round((Math.atan2(x, -y) * 180) / Math.PI), high]));
    };
    dome.addEventListener("pointerdown", (event) => {
      dome.setPointerCapture(event.pointerId);
      moved(event);
    });
    dome.addEventListener("pointermove", (event) => event.buttons && moved(event));
    dome.addEventListener("pointerup", () => void studio.commit());
  }

  private result(): void {
    byId("copy").addEventListener("click", () => {
      const text = byId("command").textContent ?? "";
      const done = (): void => studio.say("the command is copied");
      navigator.clipboard?.writeText(text).then(done, () => studio.say("the browser does not let this page copy: select the command by hand"));
      if (!navigator.clipboard) getSelection()?.selectAllChildren(byId("command"));
    });
  }

  /** The header's button saves in the format that was saved last, and shows where the picture goes. */
  private saveAtOnce(): void {
    byId("to_save").addEventListener("click", () => {
      if (!studio.isComplete) return studio.say("place an object first: then its picture can be saved");
      if (studio.told!.saves.length) return void save(studio.told!.format);
      studio.say("choose a format under Save: the next time this button takes the same");
      byId<HTMLElement>("formats").querySelector("button")?.focus();
    });
  }

  private files(): void {
    for (const id of ["open_photo", "open_object"]) {
      const input = byId<HTMLInputElement>(id);
      input.addEventListener("change", () => {
        for (const file of input.files ?? []) void studio.upload(file);
        input.value = "";
      });
    }
    const drop = byId<HTMLElement>("drop");
    addEventListener("dragover", (event) => {
      event.preventDefault();
      drop.hidden = false;
    });
    addEventListener("dragleave", (event) => event.relatedTarget === null && (drop.hidden = true));
    addEventListener("drop", async (event) => {
      event.preventDefault();
      drop.hidden = true;
      for (const file of event.dataTransfer?.files ?? []) await studio.upload(file);
    });
  }

  /** What the server tells beside the state. */
  private told(): void {
    const told = studio.told!;
    byId<HTMLButtonElement>("undo").disabled = !told.can_undo;
    byId<HTMLButtonElement>("redo").disabled = !told.can_redo;
    byId("camera_told").textContent = told.photo?.has_depth && !told.state.lines.length
      ? "The photograph has depth: the ground slopes as that says."
      : told.camera?.told ?? (told.photo ? "The camera is looked for in the picture's lines." : "");
    byId<HTMLButtonElement>("camera_found").disabled = told.camera?.file === undefined;
    byId<HTMLInputElement>("plain").disabled = Boolean(told.photo && !told.photo.has_depth && !told.state.plain);
    const photo = told.photo;
    // How a clip's camera was held, and how much light its ground loses, its track and its scene say.
    document.querySelectorAll<HTMLElement>(".of_still").forEach((each) => (each.hidden = told.clip !== null));
    byId<HTMLElement>("slice_row").hidden = photo?.slices === undefined;
    document.querySelectorAll<HTMLElement>(".of_one").forEach((each) => (each.hidden = photo?.slices !== undefined));
    if (photo?.slices !== undefined) {
      const input = byId<HTMLInputElement>("slice");
      input.max = String(photo.slices - 1);
      input.value = String(told.state.slice ?? 0);
      this.sliceTold(input.valueAsNumber);
    }
    byId("kept").textContent = `Everything is kept in ${told.project}`;
    this.choices();
    this.saves(told.saves);
    this.state();
  }

  private choices(): void {
    const told = studio.told!;
    offer("object", [["", "choose one"], ...told.objects.map((each): [string, string] => [each.path, each.name])]);
    offer("add", [["", "choose one"], ...told.objects.map((each): [string, string] => [each.path, each.name])]);
    const lenses = byId<HTMLElement>("lenses");
    if (lenses.dataset.shown !== JSON.stringify(told.lenses)) {
      lenses.dataset.shown = JSON.stringify(told.lenses);
      lenses.querySelectorAll("label").forEach((each) => each.remove());
      lenses.append(lensChoice("", "as the photograph tells", null), ...told.lenses.map((each, i) => lensChoice(each.path, each.name, i)));
    }
    const formats = byId<HTMLElement>("formats");
    if (formats.dataset.shown !== String(told.formats)) {
      formats.dataset.shown = String(told.formats);
      formats.replaceChildren();
      for (const format of told.formats) {
        const button = document.createElement("button");
        button.textContent = LONG_FORMATS[format] ?? format;
        button.dataset.format = format;
        button.addEventListener("click", () => void save(format));
        formats.append(button);
      }
    }
  }

  private saves(saves: Save[]): void {
    byId("saves").replaceChildren(...saves.map(saveLine));
  }

  private state(): void {
    const state = studio.state;
    if (!state) return;
    for (const each of SLIDERS) {
      const input = byId<HTMLInputElement>(each.id);
      const value = each.read(state);
      if (document.activeElement !== input || input.valueAsNumber !== value) input.value = String(value);
      const output = input.closest("label")!.querySelector("output")!;
      output.textContent = each.shown(value, state);
      input.setAttribute("aria-valuetext", output.textContent);
    }
    for (const { id, name } of NUMBERS) this.fill(id, state[name] === null ? "" : String(state[name]));
    this.fill("height", scaledHeight(state.height, 1, 3) ?? "");
    byId<HTMLSelectElement>("object").value = state.object ?? "";
    const objects = studio.objects;
    offer("chosen", objects.map((each, number): [string, string] => [String(number), `${number + 1}: ${nameOf(each.object)}`]));
    byId<HTMLSelectElement>("chosen").value = String(state.before.length);
    byId<HTMLElement>("chosen_row").hidden = objects.length < 2;
    byId<HTMLElement>("add_row").hidden = !objects.length;
    byId<HTMLInputElement>("sun_auto").checked = state.sun_deg === null;
    byId<HTMLInputElement>("matched").checked = state.matched;
    byId<HTMLInputElement>("plain").checked = state.plain;
    document.querySelectorAll<HTMLInputElement>("input[name=lens]").forEach((each) => (each.checked = each.value === (state.lens ?? "")));
    const [turn, high] = sunOf(state);
    const byFile = studio.told?.photo?.sun_deg;
    byId("sun_told").textContent = byFile ? `By place, time and compass in the file the sun stood ${Math.abs(byFile[0])}° to the ${byFile[0] < 0 ? "left" : "right"} and ${byFile[1]}° high, if it shone.` : "";
    byId("height_note").textContent = heightNote(state);
    const reach = (90 - high) / 0.9;
    const lamp = byId<SVGCircleElement>("lamp");
    lamp.setAttribute("cx", String(reach * Math.sin((turn * Math.PI) / 180)));
    lamp.setAttribute("cy", String(-reach * Math.cos((turn * Math.PI) / 180)));
    byId("dome").classList.toggle("off", state.sun_deg === null);
    byId("command").textContent = this.commands((studio.isChanging ? studio.shown?.command : studio.told?.command) ?? null);
    document.querySelectorAll<HTMLButtonElement>("#formats button").forEach((each) => (each.disabled = !studio.isComplete));
    byId("focus_told").textContent = focusTold(state);
  }

  /** The command of the picture, and before it that of the whole clip. */
  private commands(picture: string | null): string {
    const clip = studio.told?.clip && !studio.isChanging ? studio.told.clip.command : null;
    return [...(clip ? [clip] : []), picture ?? "Place an object first."].join("\n\n");
  }

  private fill(id: string, text: string): void {
    const input = byId<HTMLInputElement>(id);
    if (document.activeElement !== input) input.value = text;
  }

  private shown(): void {
    const shown = studio.shown!;
    byId("guessed").replaceChildren(
      ...[...groundTold(), ...shown.guessed, ...shown.warnings].map((sentence) => Object.assign(document.createElement("li"), { textContent: sentence })),
    );
    if (studio.isChanging) byId("command").textContent = this.commands(shown.command);
    if (studio.state) byId("focus_told").textContent = focusTold(studio.state);
  }
}

/** The changes, with heights by which objects keep their size in the picture where the ground moves away under them; typed metres stay. */
function keepingSizes(changes: Partial<State>): Partial<State> {
  const [photo, state] = [studio.told?.photo ?? null, studio.state];
  const [from, to] = [groundOf(photo, state), state && groundOf(photo, { ...state, ...changes })];
  if (!state || !from || !to || studio.metresTyped) return changes;
  const scaled = ({ at_px, height }: { at_px: Pair; height: string | null }): string | null => {
    const factor = (to.distance_m(at_px) ?? 0) / (from.distance_m(at_px) ?? 0);
    return height?.endsWith("px") || !Number.isFinite(factor) || !factor ? height : scaledHeight(height, factor);
  };
  const all = (placed: Placed[]): Placed[] => placed.map((each) => ({ ...each, height: scaled(each) }));
  return { ...changes, height: state.at_px && scaled({ at_px: state.at_px, height: state.height }), before: all(state.before), after: all(state.after) };
}

/** What the number of the height counts. */
function heightNote(state: State): string {
  const by = studio.told?.clip ? ", by the track" : state.measured ? ", by the known height" : " (see below)";
  const guessed = state.camera_height_m && !studio.told?.photo?.has_depth ? ` for a camera ${state.camera_height_m} m above the ground${by}` : "";
  return `Metres${guessed}, or pixels such as 120px. Wheel, pinch, + and - scale it.`;
}

/** What the ground is taken for, where no depth tells it: all metres hang on that. */
function groundTold(): string[] {
  const [told, state] = [studio.told, studio.state];
  if (!told?.photo || told.photo.has_depth || !state?.camera_height_m) return [];
  const tilt = state.camera === null && state.pitch_deg !== null ? [`The camera looks down by ${state.pitch_deg}°, which little in the picture tells: see Camera and ground, or draw Lines.`] : [];
  if (state.measured) return tilt;
  return [...tilt, `The camera is ${state.camera_height_m} m above the ground, or the table that it stands on; all metres hang on that.`];
}

async function save(format: string): Promise<void> {
  await studio.commit();
  const answer = await studio.post("/save", { format });
  if (answer) studio.take(answer);
}

const nameOf = (path: string): string => path.replace(/^.*[\\/]/, "").replace(/\.\w+$/, "");

/** Fill a list with values and their names, where it has others. */
function offer(id: string, choices: [string, string][]): void {
  const select = byId<HTMLSelectElement>(id);
  if (select.dataset.shown === JSON.stringify(choices)) return;
  select.dataset.shown = JSON.stringify(choices);
  select.replaceChildren(...choices.map(([value, name]) => new Option(name, value)));
}

/** How the lens is focused, and how much the object is blurred by that. */
function focusTold(state: State): string {
  const shown = studio.shown;
  if (!shown || !studio.isComplete) return "Click Focus here, then what is to be in focus.";
  const from = state.focus_m !== null || state.focus_at_px !== null ? "as chosen" : studio.told?.photo?.focus_m ? "as the photograph states" : studio.told?.photo?.slices ? "as the stack tells" : "on the object";
  if (studio.told?.photo?.focus_distances_m?.length === 0) return `The stack does not know its metres; the object is blurred${blurTold(shown.coc_px)}.`;
  const at = shown.focus_m === null ? "infinity" : `${Number(shown.focus_m.toPrecision(3))} m`;
  return `Focused at ${at}, ${from}; the object is blurred${blurTold(shown.coc_px)}.`;
}

const blurTold = ([least, most]: number[]): string => (least === undefined || most === undefined ? " by its distance" : ` by ${least.toFixed(1)} to ${most.toFixed(1)} px of the photograph`);

function lensChoice(path: string, name: string, number: number | null): HTMLLabelElement {
  const label = document.createElement("label");
  const input = Object.assign(document.createElement("input"), { type: "radio", name: "lens", value: path });
  input.addEventListener("change", () => void studio.commit({ lens: path || null }));
  label.append(input);
  if (number !== null) label.append(Object.assign(document.createElement("img"), { src: `/lens/${number}`, alt: "shape of its bokeh" }));
  label.append(name);
  return label;
}

function saveLine(save: Save): HTMLLIElement {
  const line = document.createElement("li");
  if (save.state === "running") {
    const cancel = Object.assign(document.createElement("button"), { textContent: `Cancel ${save.name}` });
    cancel.addEventListener("click", () => void studio.post("/cancel", { number: save.number }));
    const bar = document.createElement("progress");
    bar.setAttribute("aria-label", `making ${save.name}`);
    line.append(`making ${save.name} ... `, bar, cancel);
  } else if (save.state === "done") {
    const link = Object.assign(document.createElement("a"), { href: `/saved/${save.number}`, textContent: `Download ${save.name}` });
    link.setAttribute("download", save.name);
    line.append(link, ` (${save.seconds} s) ${save.path}`);
  } else {
    line.append(`${save.name}: ${save.state === "failed" ? save.sentence : "cancelled"}`);
  }
  return line;
}
