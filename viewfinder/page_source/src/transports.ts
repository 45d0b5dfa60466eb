// A way for pictures to come; they are tried in order, and the one that shows a picture is kept until it fails.
import { type FrameHeader, model } from "./model";
import { offerTo, refreshState, release } from "./server";
import { clock, counts } from "./timing";

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
    // Only when the server lets this page in again: a way that fails before would cover the sentence with which it refuses.
    do {
      await new Promise((done) => setTimeout(done, AGAIN_MS));
    } while (!(await letIn()));
  }
}

/** Whether the server answers and lets this page in; if not, say why. */
async function letIn(): Promise<boolean> {
  try {
    await refreshState();
    return true;
  } catch (problem) {
    // What fetch itself throws says nothing to a user; a refusal of the server does.
    model.say(problem instanceof Error && !(problem instanceof TypeError) ? problem.message : "connection lost, trying again");
    return false;
  }
}

// JPEG through a WebSocket: one picture at a time, each acknowledged when it is on the canvas, so that the next one is the newest.
export class JpegTransport implements Transport {
  readonly name = "jpeg";
  private readonly context: CanvasRenderingContext2D;
  private readonly decoder = new TextDecoder();

  constructor(private readonly canvas: HTMLCanvasElement) {
    this.context = canvas.getContext("2d", { alpha: false })!;
  }

  run(showing: () => void): Promise<string> {
    return new Promise((ended) => {
      const socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/stream`);
      socket.binaryType = "arraybuffer";
      let first = true;
      let drawn = Promise.resolve();
      const take = async (data: ArrayBuffer): Promise<void> => {
        const header = await this.draw(data);
        if (first) showing();
        first = false;
        model.show({ pixels: this.canvas, header });
        if (socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify({ ack: header.sequence }));
      };
      socket.onopen = () => {
        model.say("waiting for the camera");
        clock.start((text) => socket.readyState === WebSocket.OPEN && socket.send(text));
      };
      socket.onmessage = (event: MessageEvent<string | ArrayBuffer>) => {
        if (typeof event.data === "string") this.hear(JSON.parse(event.data), drawn);
        else drawn = take(event.data);
      };
      socket.onclose = () => {
        clock.stop();
        ended("connection lost, trying again");
      };
    });
  }

  private hear(message: { clock?: number; server_ms?: number; failure?: string; error?: string }, drawn: Promise<void>): void {
    const { failure } = message;
    if (message.server_ms !== undefined) clock.answer(message as { clock: number; server_ms: number });
    // The picture that came before it may still be decoded; shown later it would say that all is well again.
    else if (failure !== undefined) void drawn.then(() => model.fail(failure));
    else if (message.error !== undefined) model.say(message.error, 6);
  }

  private async draw(data: ArrayBuffer): Promise<FrameHeader> {
    const length = new DataView(data).getUint32(0);
    const header = JSON.parse(this.decoder.decode(new Uint8Array(data, 4, length))) as FrameHeader;
    const jpeg = new Blob([new Uint8Array(data, 4 + length)], { type: "image/jpeg" });
    const bitmap = await createImageBitmap(jpeg).catch(() => null);
    if (bitmap) {
      if (this.canvas.width !== bitmap.width || this.canvas.height !== bitmap.height) {
        this.canvas.width = bitmap.width;
        this.canvas.height = bitmap.height;
      }
      this.context.drawImage(bitmap, 0, 0);
      bitmap.close();
      const now = performance.now();
      counts.count(now);
      counts.know(header, now);
    }
    return header;
  }
}

// Video through WebRTC (WHEP): one offer, one answer; what is known of each picture comes through a data channel, by its RTP time.
const FIRST_PICTURE_MS = 6000;
const STILL_MS = 5000;
const MOST_REMEMBERED = 300;

type Told = FrameHeader & { rtp_timestamp: number };

export class WhepTransport implements Transport {
  readonly name = "whep";
  private readonly told = new Map<number, FrameHeader>();
  private untold: { rtp: number; shown_ms: number } | null = null;
  private lastShown_ms = 0;

  constructor(private readonly video: HTMLVideoElement) {}

  async run(showing: () => void): Promise<string> {
    // A network without internet has no STUN server to wait for.
    const peer = new RTCPeerConnection({ iceServers: [] });
    let resource: string | null = null;
    const leave = (): void => release(resource);
    window.addEventListener("pagehide", leave);
    try {
      peer.addTransceiver("video", { direction: "recvonly" });
      this.openStatus(peer);
      peer.ontrack = (event) => this.play(event, showing);
      resource = await offerTo("/whep", peer);
      return await this.until(peer);
    } catch (problem) {
      return problem instanceof Error ? problem.message : "video could not be opened";
    } finally {
      window.removeEventListener("pagehide", leave);
      leave();
      clock.stop();
      peer.close();
      this.video.srcObject = null;
    }
  }

  private openStatus(peer: RTCPeerConnection): void {
    const channel = peer.createDataChannel("status");
    channel.onopen = () => clock.start((text) => channel.readyState === "open" && channel.send(text));
    channel.onmessage = (event: MessageEvent<string>) => this.hear(JSON.parse(event.data));
  }

  private hear(message: Partial<Told> & { clock?: number; server_ms?: number; failure?: string; error?: string }): void {
    if (message.server_ms !== undefined) clock.answer(message as { clock: number; server_ms: number });
    else if (message.failure !== undefined) model.fail(message.failure);
    else if (message.error !== undefined) model.say(message.error, 6);
    else if (message.rtp_timestamp !== undefined) this.remember(message as Told);
  }

  private remember(header: Told): void {
    if (this.untold?.rtp === header.rtp_timestamp) {
      this.know(header, this.untold.shown_ms);
      return;
    }
    this.told.set(header.rtp_timestamp, header);
    if (this.told.size > MOST_REMEMBERED) this.told.delete(this.told.keys().next().value!);
  }

  private play(event: RTCTrackEvent, showing: () => void): void {
    // The newest picture, not the smoothest video.
    if ("jitterBufferTarget" in event.receiver) event.receiver.jitterBufferTarget = 0;
    this.video.srcObject = new MediaStream([event.track]);
    void this.video.play().catch(() => undefined);
    const onPicture: VideoFrameRequestCallback = (now, metadata) => {
      if (this.lastShown_ms === 0) showing();
      this.lastShown_ms = now;
      this.onPicture(metadata.rtpTimestamp, Math.max(now, metadata.expectedDisplayTime));
      this.video.requestVideoFrameCallback(onPicture);
    };
    this.video.requestVideoFrameCallback(onPicture);
  }

  private onPicture(rtp: number | undefined, shown_ms: number): void {
    counts.count(shown_ms);
    const header = rtp === undefined ? undefined : this.told.get(rtp);
    if (header) {
      this.told.delete(rtp!);
      this.know(header, shown_ms);
    } else {
      this.untold = rtp === undefined ? null : { rtp, shown_ms };
      model.show({ pixels: this.video, header: null });
    }
  }

  private know(header: FrameHeader, shown_ms: number): void {
    this.untold = null;
    counts.know(header, shown_ms);
    model.show({ pixels: this.video, header });
  }

  /** Resolves when no picture came in time, none comes any more, or the connection failed. */
  private until(peer: RTCPeerConnection): Promise<string> {
    const began_ms = performance.now();
    return new Promise((ended) => {
      const end = (why: string): void => {
        clearInterval(watch);
        ended(why);
      };
      const watch = setInterval(() => {
        const now = performance.now();
        if (this.lastShown_ms === 0 && now - began_ms > FIRST_PICTURE_MS) end("no video came, trying pictures");
        // A dead source sends nothing either, and says so; then it is not the way that failed.
        if (this.lastShown_ms > 0 && now - this.lastShown_ms > STILL_MS && !model.state?.failure && !document.hidden) end("the video stopped, trying again");
      }, 500);
      peer.onconnectionstatechange = () => {
        if (["failed", "disconnected", "closed"].includes(peer.connectionState)) end("the video connection was lost, trying again");
      };
    });
  }
}
