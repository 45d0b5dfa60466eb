// Enlarges what is displayed, about the fingers; nothing of it reaches the server.

const MOST = 8;

export class Zoom {
  scale = 1;
  private left_px = 0;
  private top_px = 0;

  constructor(private readonly frame: HTMLElement, private readonly stage: HTMLElement) {}

  by(factor: number, x_px: number, y_px: number, dx_px: number, dy_px: number): void {
    const scale = Math.min(MOST, Math.max(1, this.scale * factor));
    const box = this.frame.getBoundingClientRect();
    const [x, y] = [x_px - box.left, y_px - box.top];
    // What lies under the fingers stays there.
    this.left_px = x - ((x - this.left_px) * scale) / this.scale + dx_px;
    this.top_px = y - ((y - this.top_px) * scale) / this.scale + dy_px;
    this.scale = scale;
    this.apply();
  }

  pan(dx_px: number, dy_px: number): void {
    this.left_px += dx_px;
    this.top_px += dy_px;
    this.apply();
  }

  reset(): void {
    [this.scale, this.left_px, this.top_px] = [1, 0, 0];
    this.apply();
  }

  private apply(): void {
    const { clientWidth, clientHeight } = this.stage;
    this.left_px = Math.min(0, Math.max(clientWidth * (1 - this.scale), this.left_px));
    this.top_px = Math.min(0, Math.max(clientHeight * (1 - this.scale), this.top_px));
    this.stage.style.transform = `translate(${this.left_px}px, ${this.top_px}px) scale(${this.scale})`;
  }
}
