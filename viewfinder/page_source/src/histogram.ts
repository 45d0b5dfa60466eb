// The histogram of luma, drawn a few times a second: counting costs more than drawing.
import type { Marks } from "./marks";

const EVERY_MS = 200;

export class Histogram {
  private last_ms = 0;

  constructor(private readonly canvas: HTMLCanvasElement) {}

  draw(marks: Marks): void {
    const now = performance.now();
    if (now - this.last_ms < EVERY_MS) return;
    this.last_ms = now;
    const { width, height } = this.canvas;
    const context = this.canvas.getContext("2d")!;
    const bins = marks.histogram();
    context.clearRect(0, 0, width, height);
    context.fillStyle = "#e8e6e1";
    const step = width / bins.length;
    // Roots show the few pixels of lights and shadows beside the many between.
    bins.forEach((share, i) => context.fillRect(i * step, height * (1 - Math.sqrt(share)), step, height));
  }
}
