// <vf-readout>: how old the shown picture is, how many come, how many were never shown, which way they come, and where the time goes.
import { aids } from "./aids";
import { clock } from "./clock";
import { counts } from "./counting";
import { model } from "./model";

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
