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
