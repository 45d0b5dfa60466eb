// <vf-choices>: lens, f-number, renderer and view as the phone's own pickers; A/B goes back and forth between the last two views.
import { model, type State } from "./model";
import { control, refreshState } from "./server";

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
