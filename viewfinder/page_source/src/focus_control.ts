// <vf-focus>: the focus distance as a slider in dioptres (one over metres), in which blur grows evenly, and who told it.
import { distanceText, model } from "./model";
import { controlLatest } from "./server";

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
