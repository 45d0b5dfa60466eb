// JPEG through a WebSocket: one picture at a time, each acknowledged when it is on the canvas, so that the next one is the newest.
import { clock } from "./clock";
import { counts } from "./counting";
import { model, type FrameHeader } from "./model";
import type { Transport } from "./transport";

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
      socket.onopen = () => {
        model.say("waiting for the camera");
        clock.start((text) => socket.readyState === WebSocket.OPEN && socket.send(text));
      };
      socket.onmessage = async (event: MessageEvent<string | ArrayBuffer>) => {
        if (typeof event.data === "string") return this.hear(JSON.parse(event.data));
        const header = await this.draw(event.data);
        if (first) showing();
        first = false;
        model.show({ pixels: this.canvas, header });
        if (socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify({ ack: header.sequence }));
      };
      socket.onclose = () => {
        clock.stop();
        ended("connection lost, trying again");
      };
    });
  }

  private hear(message: { clock?: number; server_ms?: number; failure?: string; error?: string }): void {
    if (message.server_ms !== undefined) clock.answer(message as { clock: number; server_ms: number });
    else if (message.failure !== undefined) model.fail(message.failure);
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
