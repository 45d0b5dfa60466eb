// What stands beside the picture: pickers, objects, focus, shutter and readout.
import { aids } from "./aids";
import { distanceText, model, type State } from "./model";
import { control, controlLatest, refreshState } from "./server";
import { clock, counts } from "./timing";

// <vf-choices>: lens, f-number, renderer and view as the phone's own pickers; A/B goes back and forth between the last two views.
interface Choice {
  id: string;
  label: string;
  names(state: State): string[];
  now(state: State): string | undefined;
  message(name: string): Record<string, unknown>;
  shown?(name: string): string;
}

const CHOICES: Choice[] = [
  { id: "view", label: "View", names: (s) => s.views ?? [], now: (s) => s.view, message: (view) => ({ view }) },
  { id: "lens", label: "Lens", names: (s) => s.lenses ?? [], now: (s) => s.lens, message: (lens) => ({ lens }) },
  {
    id: "f_number",
    label: "Aperture",
    names: (s) => (s.f_numbers ?? []).map(String),
    now: (s) => (s.f_number === undefined ? undefined : String(s.f_number)),
    message: (text) => ({ f_number: Number(text) }),
    shown: (text) => `f/${Number(text).toFixed(1)}`,
  },
  { id: "renderer", label: "Renderer", names: (s) => s.renderers ?? [], now: (s) => s.renderer, message: (renderer) => ({ renderer }) },
];

export class Choices extends HTMLElement {
  private lastView = "plate";

  connectedCallback(): void {
    for (const choice of CHOICES) this.append(this.picker(choice));
    const button = document.createElement("button");
    button.id = "ab";
    button.textContent = "A/B";
    button.title = "back to the view before this one";
    button.addEventListener("click", () => void this.choose(CHOICES[0]!, this.lastView));
    this.querySelector("#view")!.after(button);
    model.addEventListener("state", () => this.onState());
  }

  private picker(choice: Choice): HTMLElement {
    const label = document.createElement("label");
    label.append(choice.label);
    const select = document.createElement("select");
    select.id = choice.id;
    select.addEventListener("change", () => void this.choose(choice, select.value));
    label.append(select);
    return label;
  }

  private async choose(choice: Choice, name: string): Promise<void> {
    const before = model.state?.view;
    const answer = await control(choice.message(name));
    if (answer && choice.id === "view" && before && before !== name) this.lastView = before;
    await refreshState().catch(() => undefined);
  }

  private onState(): void {
    const state = model.state!;
    for (const choice of CHOICES) {
      const select = this.querySelector<HTMLSelectElement>(`#${choice.id}`)!;
      const now = choice.now(state);
      const names = [...new Set([...choice.names(state), ...(now === undefined ? [] : [now])])];
      if (select.dataset["names"] !== names.join("\n")) {
        select.replaceChildren(...names.map((name) => new Option(choice.shown?.(name) ?? name, name)));
        select.dataset["names"] = names.join("\n");
      }
      if (now !== undefined && document.activeElement !== select) select.value = now;
      select.parentElement!.hidden = choice.names(state).length === 0;
      select.disabled = !model.mayControl;
    }
    const button = this.querySelector<HTMLButtonElement>("#ab")!;
    button.disabled = !model.mayControl || !state.views?.includes(this.lastView);
  }
}

// <vf-objects>: which object a finger drags, and which are shown.
/** The object that a drag on the picture moves; empty for none. */
export const selection = { name: "" };

export class ObjectPicker extends HTMLElement {
  connectedCallback(): void {
    this.innerHTML = `<label>Object<select id="object"></select></label>
      <label class="switch"><input id="visible" type="checkbox"> shown</label>
      <label class="switch" id="smooth_label"><input id="smoothing" type="checkbox"> smooth tracking</label>`;
    this.find("object").addEventListener("change", () => this.onPick());
    this.find("visible").addEventListener("change", () => void this.send({ object: { name: selection.name, visible: this.find("visible").checked } }));
    this.find("smoothing").addEventListener("change", () => void this.send({ smoothing: this.find("smoothing").checked }));
    model.addEventListener("state", () => this.onState());
  }

  private find(id: string): HTMLInputElement {
    return this.querySelector(`#${id}`)!;
  }

  private onPick(): void {
    selection.name = this.find("object").value;
    if (selection.name) model.say(`drag ${selection.name} on the picture`, 3);
    this.onState();
  }

  private async send(message: Record<string, unknown>): Promise<void> {
    await control(message);
    await refreshState().catch(() => undefined);
  }

  private onState(): void {
    const { objects = [], smoothing } = model.state!;
    const select = this.find("object");
    const names = objects.map((each) => each.name);
    if (!names.includes(selection.name)) selection.name = "";
    if (select.dataset["names"] !== names.join("\n")) {
      select.replaceChildren(new Option("none", ""), ...names.map((name) => new Option(name, name)));
      select.dataset["names"] = names.join("\n");
    }
    select.value = selection.name;
    select.parentElement!.hidden = names.length === 0;
    const picked = objects.find((each) => each.name === selection.name);
    this.find("visible").parentElement!.hidden = !picked;
    this.find("visible").checked = picked?.visible ?? false;
    this.find("smooth_label").hidden = typeof smoothing !== "boolean";
    this.find("smoothing").checked = smoothing === true;
    for (const id of ["object", "visible", "smoothing"]) this.find(id).disabled = !model.mayControl;
  }
}

// <vf-focus>: the focus distance as a slider in dioptres (one over metres), in which blur grows evenly, and who told it.
const INFINITY_BELOW = 0.01;
const QUIET_MS = 1500;

export class FocusControl extends HTMLElement {
  private slider!: HTMLInputElement;
  private metres!: HTMLOutputElement;
  private touched_ms = -Infinity;

  connectedCallback(): void {
    this.innerHTML = `<label for="focus">Focus <span id="focus_from"></span><output id="metres" for="focus">-</output></label>
      <input id="focus" type="range" min="0" max="1" step="any" disabled>
      <div class="ends"><span>∞</span><span id="nearest"></span></div>`;
    this.slider = this.querySelector("#focus")!;
    this.metres = this.querySelector("#metres")!;
    this.slider.addEventListener("input", () => this.ask());
    model.addEventListener("state", () => this.onState());
    model.addEventListener("frame", () => this.onFrame());
  }

  private ask(): void {
    this.touched_ms = performance.now();
    const dioptres = Number(this.slider.value);
    const distance_m = dioptres < INFINITY_BELOW ? null : 1 / dioptres;
    this.metres.textContent = distanceText(distance_m);
    void controlLatest("focus", { focus: { distance_m } });
  }

  private onState(): void {
    const { dioptre_range, focus_distance_m } = model.state!;
    this.hidden = dioptre_range === undefined;
    this.querySelector("#focus_from")!.textContent = toldBy(model.state!.focus_from);
    if (dioptre_range === undefined) return;
    [this.slider.min, this.slider.max] = dioptre_range.map(String) as [string, string];
    this.slider.disabled = !model.mayControl;
    this.querySelector("#nearest")!.textContent = distanceText(1 / dioptre_range[1]);
    if (focus_distance_m !== undefined && model.shown === null) this.follow(focus_distance_m);
  }

  private onFrame(): void {
    const header = model.shown!.header;
    if (header?.focus_distance_m === undefined) return;
    this.metres.classList.toggle("pending", header.focus_pending === true);
    if (!header.focus_pending) this.follow(header.focus_distance_m);
  }

  /** Show what somebody else set, unless a finger is on the slider. */
  private follow(distance_m: number | null): void {
    if (performance.now() - this.touched_ms < QUIET_MS) return;
    this.slider.value = String(distance_m === null ? 0 : 1 / distance_m);
    this.metres.textContent = distanceText(distance_m);
  }
}

function toldBy(name: string | null | undefined): string {
  if (name === undefined) return "";
  return name === null ? "from the file of the lens" : name.startsWith("by ") ? name : `from ${name}`;
}

// <vf-shutter>: capture and record, where the thumb is.
const SHORT_OF_ROOM_S = 300;

export class Shutter extends HTMLElement {
  private began_ms = 0;

  connectedCallback(): void {
    this.innerHTML = `<output id="timer" aria-live="off" hidden></output>
      <button id="record" aria-label="record" aria-pressed="false"></button>
      <button id="capture" aria-label="capture"></button>`;
    this.button("capture").addEventListener("click", () => void this.capture());
    this.button("record").addEventListener("click", () => void this.record());
    model.addEventListener("state", () => this.onState());
    setInterval(() => this.showTime(), 250);
  }

  private button(id: string): HTMLButtonElement {
    return this.querySelector(`#${id}`)!;
  }

  private async capture(): Promise<void> {
    this.button("capture").disabled = true;
    model.say("capturing");
    const answer = await control({ capture: {} });
    if (answer) model.say(`saved ${String(answer["bundle"])}`, 5);
    this.onState();
  }

  private async record(): Promise<void> {
    await control({ record: !model.state?.recording });
    await refreshState().catch(() => undefined);
  }

  private onState(): void {
    const { can_capture, can_record, recording, recorded_s } = model.state!;
    this.began_ms = performance.now() - 1000 * (recorded_s ?? 0);
    document.body.classList.toggle("recording", recording === true);
    this.showTime();
    this.button("capture").hidden = !can_capture;
    this.button("record").hidden = !can_record;
    this.button("capture").disabled = this.button("record").disabled = !model.mayControl;
    this.button("record").setAttribute("aria-pressed", String(recording === true));
    this.hidden = !can_capture && !can_record;
  }

  /** How long the take is, and how much longer the disk will do where that is not long. */
  private showTime(): void {
    const { recording, room_s } = model.state ?? {};
    const timer = this.querySelector<HTMLOutputElement>("#timer")!;
    timer.hidden = recording !== true;
    const short = room_s !== undefined && room_s !== null && room_s < SHORT_OF_ROOM_S;
    timer.textContent = minutes(performance.now() - this.began_ms) + (short ? ` · disk full in ${minutes(1000 * room_s)}` : "");
    timer.classList.toggle("short", short);
  }
}

function minutes(time_ms: number): string {
  const seconds = Math.floor(time_ms / 1000);
  return `${Math.floor(seconds / 60)}:${String(seconds % 60).padStart(2, "0")}`;
}

// <vf-readout>: how old the shown picture is, how many come, how many were never shown, which way they come, and where the time goes.
const WAYS: Record<string, string> = { whep: "video", jpeg: "pictures" };

export class Readout extends HTMLElement {
  connectedCallback(): void {
    this.innerHTML = `<div><b id="age">-</b><span>ms old</span></div>
      <div><b id="fps">-</b><span>frames/s</span></div>
      <div><b id="dropped">0</b><span>dropped</span></div>
      <div><b id="way">-</b><span>sent as</span></div>
      <p id="times" hidden></p>`;
    setInterval(() => this.refresh(), 250);
  }

  private refresh(): void {
    const set = (id: string, text: string): void => {
      this.querySelector(`#${id}`)!.textContent = text;
    };
    if (counts.age_ms !== null && clock.known) set("age", Math.max(0, counts.age_ms).toFixed(0));
    set("fps", counts.fps?.toFixed(1) ?? "-");
    set("dropped", String(counts.dropped));
    set("way", WAYS[model.way] ?? "-");
    const header = model.shown?.header;
    const stages = Object.entries(header?.stages_ms ?? {}).map(([name, took_ms]) => `${name} ${took_ms.toFixed(1)}`);
    if (header?.layer_age_ms) stages.push(`layer ${header.layer_age_ms.toFixed(0)} old`);
    set("times", stages.length ? `${stages.join(" · ")} ms` : "");
    this.querySelector<HTMLElement>("#times")!.hidden = !aids.has("times");
  }
}
