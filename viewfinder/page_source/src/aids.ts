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
