// The aids that a viewer switches on for himself, the switches, and the level of this phone.
import { model } from "./model";

// The aids that a viewer switches on for himself; they are kept in this browser.
export const AIDS = {
  peakReal: "peaking: real",
  peakVirtual: "peaking: virtual",
  zebra: "zebra",
  histogram: "histogram",
  grid: "grid",
  level: "level of this phone",
  times: "times",
  leftHand: "left hand",
} as const;

export type Aid = keyof typeof AIDS;

const KEPT = "mrbokeh-aids";

class Aids extends EventTarget {
  private readonly on = new Set<Aid>(load());

  has(aid: Aid): boolean {
    return this.on.has(aid);
  }

  set(aid: Aid, on: boolean): void {
    if (on) this.on.add(aid);
    else this.on.delete(aid);
    try {
      localStorage.setItem(KEPT, JSON.stringify([...this.on]));
    } catch {
      // A browser that keeps nothing still switches.
    }
    this.dispatchEvent(new Event("change"));
  }
}

function load(): Aid[] {
  try {
    const kept: unknown = JSON.parse(localStorage.getItem(KEPT) ?? "[]");
    return Array.isArray(kept) ? kept.filter((each): each is Aid => each in AIDS) : [];
  } catch {
    return [];
  }
}

export const aids = new Aids();

// The level: how this phone is tilted, from the angles of deviceorientation, which browsers give to secure pages only.
export const levelAllowed = window.isSecureContext && "DeviceOrientationEvent" in window;

/** iOS asks its user, and only in answer to a touch; true if the angles will come. */
export async function askForLevel(): Promise<boolean> {
  const kind = DeviceOrientationEvent as unknown as { requestPermission?: () => Promise<string> };
  return !kind.requestPermission || (await kind.requestPermission().catch(() => "denied")) === "granted";
}

/** Where up is, seen on the screen: [right, up, towards the eye], of length 1. Angles in degrees; screen: of screen.orientation. */
export function upOnScreen(beta: number, gamma: number, screen: number): [number, number, number] {
  const [b, g, s] = [beta, gamma, screen].map((angle) => (angle * Math.PI) / 180) as [number, number, number];
  // The last row of Rz(alpha) Rx(beta) Ry(gamma), as the W3C's Device Orientation defines the angles.
  const [x, y, z] = [-Math.cos(b) * Math.sin(g), Math.sin(b), Math.cos(b) * Math.cos(g)];
  return [x * Math.cos(s) - y * Math.sin(s), x * Math.sin(s) + y * Math.cos(s), z];
}

export function showLevel(line: HTMLElement, active: () => boolean): void {
  if (!levelAllowed) return;
  window.addEventListener("deviceorientation", (event) => {
    line.hidden = !active() || event.beta === null || event.gamma === null;
    if (line.hidden) return;
    const [right, up, towards] = upOnScreen(event.beta!, event.gamma!, screen.orientation?.angle ?? 0);
    const roll = (Math.atan2(right, up) * 180) / Math.PI;
    // Where the screen faces up its camera looks down, and the horizon lies higher; the whole height for a right angle.
    const down = Math.asin(Math.max(-1, Math.min(1, towards))) / (Math.PI / 2);
    line.style.transform = `translateY(${-100 * down}%) rotate(${roll}deg)`;
    line.classList.toggle("even", Math.abs(roll) < 0.7);
  });
}

// <vf-aids>: a switch for each aid that this browser can give.
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
