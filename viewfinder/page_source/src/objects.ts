// <vf-objects>: which object a finger drags, and which are shown.
import { model } from "./model";
import { control, refreshState } from "./server";

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
