// Video through WebRTC (WHEP): one offer, one answer; what is known of each picture comes through a data channel, by its RTP time.
import { clock } from "./clock";
import { counts } from "./counting";
import { model, type FrameHeader } from "./model";
import { offerTo, release } from "./sdp_exchange";
import type { Transport } from "./transport";

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
