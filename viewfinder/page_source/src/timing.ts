// The server's clock in the page's time, and how old, how many and how complete the pictures are.
import type { FrameHeader } from "./model";

// Server time minus page time, from the exchange that took the least time: it cannot be more wrong than half of that.
export class ServerClock {
  offset_ms = 0;
  roundTrip_ms = Infinity;
  private asked = 0;
  private timer = 0;

  /** Ask through a channel, often at first; `answer` takes what comes back. */
  start(send: (text: string) => void): void {
    this.stop();
    this.roundTrip_ms = Infinity;
    this.asked = 0;
    const ask = (): void => {
      send(JSON.stringify({ clock: performance.now() }));
      this.asked += 1;
      this.timer = window.setTimeout(ask, this.asked < 8 ? 150 : 5000);
    };
    ask();
  }

  answer(message: { clock: number; server_ms: number }): void {
    const now = performance.now();
    const roundTrip_ms = now - message.clock;
    // A little forgetting, because the clocks of two machines drift apart.
    this.roundTrip_ms += 0.01;
    if (roundTrip_ms <= this.roundTrip_ms) {
      this.roundTrip_ms = roundTrip_ms;
      this.offset_ms = message.server_ms - (message.clock + now) / 2;
    }
  }

  stop(): void {
    clearTimeout(this.timer);
  }

  get known(): boolean {
    return this.roundTrip_ms < Infinity;
  }
}

export const clock = new ServerClock();

// How old the shown picture is, how many come per second, and how many captures were never shown.
const SPAN_MS = 2000;

class Counts {
  shown = 0;
  dropped = 0;
  age_ms: number | null = null;
  private last: number | null = null;
  private readonly times: number[] = [];

  /** A new connection: the gap to the last picture is nobody's drop. */
  restart(): void {
    this.last = null;
    this.times.length = 0;
  }

  /** A picture is on the screen since shown_ms of the page's time. */
  count(shown_ms: number): void {
    this.shown += 1;
    this.times.push(shown_ms);
    while (this.times.length > 1 && this.times[0]! < shown_ms - SPAN_MS) this.times.shift();
  }

  /** What is known of a picture that was shown at shown_ms. */
  know(header: FrameHeader, shown_ms: number): void {
    if (this.last !== null) this.dropped += Math.max(0, header.sequence - this.last - 1);
    this.last = header.sequence;
    this.age_ms = shown_ms + clock.offset_ms - header.captured_ms;
  }

  get fps(): number | null {
    const span = this.times[this.times.length - 1]! - this.times[0]!;
    return span > 0 ? (1000 * (this.times.length - 1)) / span : null;
  }
}

export const counts = new Counts();
