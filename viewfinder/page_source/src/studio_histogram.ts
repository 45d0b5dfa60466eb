// Histogram of the picture on the screen, channel by channel, and how much of it is clipped.
import { byId, studio } from "./studio_model";

const COLOURS = ["#ff6b6b", "#5ee078", "#6db3ff"];
const LEVELS = 256;
const REST_MS = 200;

export class Histogram {
  private later: ReturnType<typeof setTimeout> | undefined;

  constructor() {
    studio.addEventListener("picture", () => {
      clearTimeout(this.later);
      this.later = setTimeout(() => this.draw(), REST_MS);
    });
  }

  private draw(): void {
    const picture = byId<HTMLCanvasElement>("picture");
    const canvas = byId<HTMLCanvasElement>("histogram");
    // A folded panel shows none.
    if (!picture.width || !canvas.offsetWidth) return;
    const { data } = picture.getContext("2d")!.getImageData(0, 0, picture.width, picture.height);
    const counts = COLOURS.map(() => new Uint32Array(LEVELS));
    for (let i = 0; i < data.length; i++) if (i % 4 < 3) counts[i % 4]![data[i]!]!++;
    const pixels = data.length / 4;
    // A clipped end would press all else flat.
    const most = Math.max(1, ...counts.flatMap((each) => [...each.subarray(1, LEVELS - 1)]));
    const context = canvas.getContext("2d")!;
    context.clearRect(0, 0, canvas.width, canvas.height);
    context.globalCompositeOperation = "lighter";
    counts.forEach((each, channel) => {
      context.fillStyle = COLOURS[channel]! + "90";
      for (let level = 0; level < LEVELS; level++) {
        const high = Math.min(1, each[level]! / most) * canvas.height;
        context.fillRect(level, canvas.height - high, 1, high);
      }
    });
    const share = (level: number): string => ((100 * Math.max(...counts.map((each) => each[level]!))) / pixels).toFixed(1);
    byId("clipped").textContent = `Black ${share(0)} %, white ${share(LEVELS - 1)} % of the pixels.`;
  }
}
