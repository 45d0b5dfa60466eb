// <vf-shutter>: capture and record, where the thumb is.
import { model } from "./model";
import { control, refreshState } from "./server";

export class Shutter extends HTMLElement {
  connectedCallback(): void {
    this.innerHTML = `<button id="record" aria-label="record" aria-pressed="false"></button>
      <button id="capture" aria-label="capture"></button>`;
    this.button("capture").addEventListener("click", () => void this.capture());
    this.button("record").addEventListener("click", () => void this.record());
    model.addEventListener("state", () => this.onState());
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
    const { can_capture, can_record, recording } = model.state!;
    this.button("capture").hidden = !can_capture;
    this.button("record").hidden = !can_record;
    this.button("capture").disabled = this.button("record").disabled = !model.mayControl;
    this.button("record").setAttribute("aria-pressed", String(recording === true));
    this.hidden = !can_capture && !can_record;
  }
}
