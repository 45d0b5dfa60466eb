// How old the shown picture is, how many come per second, and how many captures were never shown.
import { clock } from "./clock";
import type { FrameHeader } from "./model";

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
