// A way for pictures to come; they are tried in order, and the one that shows a picture is kept until it fails.
import { counts } from "./counting";
import { JpegTransport } from "./jpeg_transport";
import { model } from "./model";
import { refreshState } from "./server";
import { WhepTransport } from "./whep_transport";

export interface Transport {
  readonly name: string;
  /** Runs until the way fails or ends, with a reason in a sentence; `showing` is called when the first picture is on the page. */
  run(showing: () => void): Promise<string>;
}

const AGAIN_MS = 1000;

function offered(canvas: HTMLCanvasElement, video: HTMLVideoElement, names: string[]): Transport[] {
  const wanted = new URLSearchParams(location.search).get("transport");
  const all: Record<string, () => Transport> = { whep: () => new WhepTransport(video), jpeg: () => new JpegTransport(canvas) };
  const usable = names.filter((name) => (name !== "whep" || "RTCPeerConnection" in window) && (wanted ?? name) === name);
  return usable.flatMap((name) => (all[name] ? [all[name]()] : []));
}

/** Keep pictures coming for ever. */
export async function watch(canvas: HTMLCanvasElement, video: HTMLVideoElement): Promise<void> {
  for (;;) {
    for (const transport of offered(canvas, video, model.state?.transports ?? [])) {
      counts.restart();
      let shown = false;
      const why = await transport.run(() => {
        shown = true;
        video.hidden = transport.name !== "whep";
        canvas.hidden = !video.hidden;
        model.setWay(transport.name);
        if (!model.state?.failure) model.say("");
      });
      model.say(why);
      if (shown) break;
    }
    await new Promise((done) => setTimeout(done, AGAIN_MS));
    // What fetch itself throws says nothing to a user; a refusal of the server does.
    await refreshState().catch((problem: Error) => model.say(problem instanceof TypeError ? "connection lost, trying again" : problem.message));
  }
}
