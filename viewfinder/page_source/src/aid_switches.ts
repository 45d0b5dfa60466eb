// <vf-aids>: a switch for each aid that this browser can give.
import { AIDS, aids, type Aid } from "./aids";
import { levelAllowed } from "./level";
import { model } from "./model";

export class AidSwitches extends HTMLElement {
  connectedCallback(): void {
    this.innerHTML = "<details><summary>Aids</summary><div></div></details>";
    for (const aid of Object.keys(AIDS) as Aid[]) {
      if (aid === "level" && !levelAllowed) continue;
      const button = document.createElement("button");
      button.id = `aid_${aid}`;
      button.textContent = AIDS[aid];
      button.addEventListener("click", () => aids.set(aid, !aids.has(aid)));
      this.querySelector("div")!.append(button);
    }
    aids.addEventListener("change", () => this.refresh());
    model.addEventListener("state", () => this.refresh());
    this.refresh();
  }

  private refresh(): void {
    for (const aid of Object.keys(AIDS) as Aid[]) this.querySelector(`#aid_${aid}`)?.setAttribute("aria-pressed", String(aids.has(aid)));
    document.body.classList.toggle("left-hand", aids.has("leftHand"));
    // Without a matte everything counts as real.
    const apart = model.state?.matte === true;
    this.querySelector<HTMLElement>("#aid_peakVirtual")!.hidden = !apart;
    this.querySelector("#aid_peakReal")!.textContent = apart ? AIDS.peakReal : "peaking";
  }
}
