// The viewfinder's page: lets itself in, then keeps showing the stream and the state.
import { AidSwitches } from "./aids";
import { Gallery } from "./gallery";
import { model } from "./model";
import { Choices, FocusControl, ObjectPicker, Readout, Shutter } from "./panel";
import { PictureView } from "./picture";
import { enter, refreshState } from "./server";
import { clock, counts } from "./timing";
import { watch } from "./transports";

const STATE_EVERY_MS = 2000;

async function start(): Promise<void> {
  await enter();
  await refreshState();
  const picture = document.querySelector<PictureView>("vf-picture")!;
  void watch(picture.find<HTMLCanvasElement>("picture"), picture.find<HTMLVideoElement>("video"));
  setInterval(() => void poll(), STATE_EVERY_MS);
  keepAwake();
}

/** What others changed, and whether the source lives. */
async function poll(): Promise<void> {
  if (document.hidden) return;
  const before = model.state?.failure ?? null;
  const state = await refreshState().catch(() => null);
  if (state?.failure) model.say(state.failure);
  else if (state && before) model.say("");
}

/** A screen that goes dark is no viewfinder; only secure pages may ask. */
function keepAwake(): void {
  const ask = (): void => void navigator.wakeLock?.request("screen").catch(() => undefined);
  ask();
  document.addEventListener("visibilitychange", () => !document.hidden && ask());
}

customElements.define("vf-picture", PictureView);
customElements.define("vf-readout", Readout);
customElements.define("vf-focus", FocusControl);
customElements.define("vf-choices", Choices);
customElements.define("vf-objects", ObjectPicker);
customElements.define("vf-aids", AidSwitches);
customElements.define("vf-shutter", Shutter);
customElements.define("vf-gallery", Gallery);

// What tests and the curious read in the console.
Object.assign(window, {
  viewfinder: {
    counts,
    clock,
    model,
    get age(): number | null {
      return counts.age_ms;
    },
    get focus(): number | null | undefined {
      return model.shown?.header?.focus_distance_m;
    },
  },
});

start().catch((problem: unknown) => model.say(problem instanceof Error ? problem.message : "the viewfinder does not answer"));
