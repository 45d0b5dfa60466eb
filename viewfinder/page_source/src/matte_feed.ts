// The coverage of the virtual layer, fetched a few times a second while peaking needs to tell real from virtual.
import { model } from "./model";

const EVERY_MS = 200;

export class MatteFeed {
  private running = false;

  constructor(private readonly take: (matte: ImageBitmap) => void) {}

  run(on: boolean): void {
    if (on && !this.running) void this.loop();
    this.running = on;
  }

  private async loop(): Promise<void> {
    // Begun before `running` is set.
    await Promise.resolve();
    while (this.running) {
      if (model.state?.matte) await this.fetchOne().catch(() => undefined);
      await new Promise((done) => setTimeout(done, EVERY_MS));
    }
  }

  private async fetchOne(): Promise<void> {
    const answer = await fetch("/matte");
    if (!answer.ok) return;
    const bitmap = await createImageBitmap(await answer.blob());
    this.take(bitmap);
    bitmap.close();
  }
}
